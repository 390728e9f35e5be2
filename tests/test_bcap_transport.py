"""The three links, at the other end of which anything may be."""

from __future__ import annotations

import os
import socket
import struct
import threading
import time
import tty

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.bcap.packet import MAX_DATAGRAM, Function, Packet, encode
from drivers.bcap.transport import SerialLink, TcpLink, UdpLink
from drivers.bcap.variant import PacketError, Type, Variant, bstr, i4, r8_array
from drivers.errors import DeviceLostError, DeviceNotFoundError

REQUEST = Packet(1, 0, Function.SERVICE_START)
REPLY = Packet(1, 0, 0, (r8_array((1.0, 2.0)),))
TOO_LONG = Packet(1, 1, 3, (Variant(Type.UI1, (0,) * MAX_DATAGRAM),))


@pytest.fixture(scope="module")
def listener():
    with socket.create_server(("127.0.0.1", 0)) as made:
        made.settimeout(10.0)
        yield made


class Stream:
    """A TCP link, and the socket at its other end."""

    def __init__(self, listener):
        self.link = TcpLink("arm", "127.0.0.1", listener.getsockname()[1])
        self.link.open(5.0)
        self.peer, _ = listener.accept()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.link.close()
        self.peer.close()


def drained(link):
    while link.receive(5.0) is not None:
        pass


def repeated(times, link, packet):
    for _ in range(times):
        link.send(packet)
        link.receive(0.01)


class TestTcp:
    def test_packets_pass_in_pieces_and_in_one(self, listener):
        with Stream(listener) as stream:
            stream.link.send(REQUEST)
            assert stream.peer.recv(100) == encode(REQUEST)
            stream.peer.sendall(encode(REPLY) + encode(REPLY)[:7])
            assert stream.link.receive(5.0) == REPLY
            assert stream.link.receive(0.02) is None
            assert stream.link.is_amid_packet()
            stream.peer.sendall(encode(REPLY)[7:])
            assert stream.link.receive(5.0) == REPLY
            assert not stream.link.is_amid_packet()

    def test_it_does_not_wait_for_more_before_it_sends(self, listener):
        with Stream(listener) as stream:
            assert stream.link._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)

    def test_nothing_comes_within_its_time(self, listener):
        with Stream(listener) as stream:
            begin = time.monotonic()
            assert stream.link.receive(0.1) is None
            assert 0.09 < time.monotonic() - begin < 2.0

    @pytest.mark.parametrize("sent", [b"", encode(REPLY)[:9]], ids=["between packets", "amid one"])
    def test_the_end_of_the_connection_is_a_loss(self, listener, sent):
        with Stream(listener) as stream:
            stream.peer.sendall(sent)
            stream.peer.close()
            with pytest.raises(DeviceLostError, match="closed"):
                stream.link.receive(5.0)

    def test_a_reset_is_a_loss(self, listener):
        with Stream(listener) as stream:
            stream.peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            stream.peer.close()
            with pytest.raises(DeviceLostError, match="reset"):
                stream.link.receive(5.0)

    def test_a_length_of_4_gib_is_a_loss_at_once(self, listener):
        with Stream(listener) as stream:
            stream.peer.sendall(b"\x01\xff\xff\xff\xff")
            with pytest.raises(DeviceLostError, match="4294967295 bytes"):
                stream.link.receive(5.0)

    @given(st.binary(min_size=1, max_size=400))
    @example(encode(REPLY)[:-1] + b"\x05")
    @example(encode(REPLY) + b"HTTP/1.1 400 Bad Request")
    @settings(max_examples=40, deadline=None)
    def test_garbage_is_a_packet_or_silence_or_a_loss(self, listener, data):
        with Stream(listener) as stream:
            stream.peer.sendall(data)
            stream.peer.shutdown(socket.SHUT_WR)
            with pytest.raises(DeviceLostError):
                drained(stream.link)

    def test_a_peer_that_takes_nothing_more_is_a_loss(self, listener):
        large = Packet(1, 0, 3, (bstr("x" * 400_000),))
        begin = time.monotonic()
        with Stream(listener) as stream, pytest.raises(DeviceLostError, match="takes no packets"):
            repeated(100, stream.link, large)
        assert time.monotonic() - begin < 20.0

    def test_nobody_there_is_not_found(self):
        with socket.create_server(("127.0.0.1", 0)) as made:
            port = made.getsockname()[1]
        with pytest.raises(DeviceNotFoundError, match=f"tcp 127.0.0.1:{port}"):
            TcpLink("arm", "127.0.0.1", port).open(1.0)

    def test_a_link_that_is_not_open_is_lost_and_closes_twice(self):
        link = TcpLink("arm", "127.0.0.1", 1)
        link.close()
        link.close()
        with pytest.raises(DeviceLostError):
            link.send(REQUEST)


@pytest.fixture
def datagrams():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(5.0)
        link = UdpLink("arm", "127.0.0.1", peer.getsockname()[1])
        link.open(1.0)
        link.send(REQUEST)
        data, address = peer.recvfrom(1000)
        assert data == encode(REQUEST)
        peer.connect(address)
        yield link, peer
        link.close()


class TestUdp:
    def test_what_is_no_packet_is_passed_over(self, datagrams):
        link, peer = datagrams
        for data in (b"", b"x", encode(REPLY)[:-1], encode(REPLY) + b"\x04", encode(REPLY)):
            peer.send(data)
        assert link.receive(5.0) == REPLY
        assert link.ignored == 4
        assert link.receive(0.02) is None

    def test_what_comes_from_elsewhere_is_not_heard(self, datagrams):
        link, _ = datagrams
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(encode(REPLY), link._socket.getsockname())
            assert link.receive(0.05) is None

    @given(st.binary(max_size=600))
    @settings(max_examples=50, deadline=None)
    def test_garbage_is_passed_over(self, data):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            peer.bind(("127.0.0.1", 0))
            link = UdpLink("arm", "127.0.0.1", peer.getsockname()[1])
            link.open(1.0)
            peer.sendto(data, link._socket.getsockname())
            peer.sendto(encode(REPLY), link._socket.getsockname())
            assert link.receive(5.0) == REPLY
            link.close()

    def test_a_packet_that_no_datagram_may_carry_is_not_sent(self, datagrams):
        with pytest.raises(PacketError, match="488"):
            datagrams[0].send(TOO_LONG)

    def test_nobody_there_any_more_is_a_loss(self, datagrams):
        link, peer = datagrams
        peer.close()
        with pytest.raises(DeviceLostError, match="nobody listens"):
            repeated(50, link, REQUEST)

    def test_an_address_that_there_is_not_is_not_found(self):
        with pytest.raises(DeviceNotFoundError, match=r"udp no\.such\.host\.invalid"):
            UdpLink("arm", "no.such.host.invalid", 5007).open(1.0)


@pytest.fixture
def line():
    master, slave = os.openpty()
    tty.setraw(slave)
    link = SerialLink("arm", os.ttyname(slave), 38400)
    link.open(1.0)
    yield link, master
    link.close()
    for number in (master, slave):
        os.close(number)


class TestSerial:
    def test_packets_pass_with_their_crc(self, line):
        link, master = line
        link.send(Packet(1, 1, Function.SERVICE_START))
        assert os.read(master, 100).hex() == "0112000000010001000100000000" + "0069f404"
        os.write(master, encode(REPLY, crc=True)[:10])
        assert link.receive(0.02) is None
        os.write(master, encode(REPLY, crc=True)[10:])
        assert link.receive(5.0) == REPLY

    @given(st.binary(max_size=60))
    @example(b"\x01\x30\x00\x00\x00")
    @settings(max_examples=60, deadline=None)
    def test_after_noise_the_next_packets_are_found(self, noise):
        """As a caller has it, who repeats a call that is not answered."""
        master, slave = os.openpty()
        try:
            tty.setraw(slave)
            link = SerialLink("arm", os.ttyname(slave), 38400)
            link.open(1.0)
            os.write(master, noise)
            for _ in range(30):
                link.send(REQUEST)
                os.write(master, encode(REPLY, crc=True))
                if link.receive(0.01) == REPLY:
                    break
            else:
                raise AssertionError
            link.close()
        finally:
            os.close(master)
            os.close(slave)

    def test_a_changed_bit_is_no_packet(self, line):
        link, master = line
        data = bytearray(encode(REPLY, crc=True))
        data[30] ^= 4
        os.write(master, bytes(data))
        assert link.receive(0.05) is None
        assert link.ignored > 0

    def test_a_packet_that_the_line_may_not_carry_is_not_sent(self, line):
        with pytest.raises(PacketError, match="488"):
            line[0].send(TOO_LONG)

    def test_a_line_that_nobody_reads_loses_packets_in_bounded_time(self, line):
        link, _ = line
        packet = Packet(1, 1, 3, (Variant(Type.UI1, (0,) * 400),))
        begin = time.monotonic()
        for _ in range(14):
            link.send(packet)
        assert time.monotonic() - begin < 10.0

    def test_an_unplugged_line_is_a_loss(self):
        master, slave = os.openpty()
        tty.setraw(slave)
        link = SerialLink("arm", os.ttyname(slave), 38400)
        link.open(1.0)
        os.close(slave)
        timer = threading.Timer(0.1, os.close, (master,))
        timer.start()
        with pytest.raises(DeviceLostError):
            link.receive(5.0)
        timer.join()
        link.close()

    def test_a_port_that_there_is_not_is_not_found(self):
        with pytest.raises(DeviceNotFoundError, match="/dev/no-such-port"):
            SerialLink("arm", "/dev/no-such-port", 38400).open(1.0)


def test_a_handle_fits_into_every_link():
    assert len(encode(Packet(1, 1, 101, (i4(2),)), crc=True)) == 32
