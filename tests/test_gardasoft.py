import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.gardasoft import protocol as gardasoft
from drivers.gardasoft.protocol import Event, GardasoftError, Reply, ReplyReader, Version

STATUS = (
    "CH 1, MD 0, S 50.0%, DL 0.010ms, PU 1.000ms, RT 0.0ms, IP 1, FL 0, CS 0.000A, RA 0.700A",
    "RA 0.700A, S 50%, CH 1",
    "S:50.0 % , RA=0.7A",
    "XX whatever, S 50.0%, RA 700mA, NEW 7",
)
TERMINATORS = [b"\r\n", b"\n\r", b"\r", b"\n", b";"]


def read(data, chunks=()):
    """All replies in `data`, fed in pieces of these sizes and then the rest."""
    reader, replies = ReplyReader(), []
    for size in chunks:
        replies += reader.feed(data[:size])
        data = data[size:]
    return replies + reader.feed(data)


class TestCommands:
    @pytest.mark.parametrize(
        ("command", "sent"),
        [
            (gardasoft.version(), b"VR\r"),
            (gardasoft.rating(1, 0, 0.7), b"VL1,0,0.7\r"),
            (gardasoft.rating(2, 24, 0), b"VL2,24,0\r"),
            (gardasoft.continuous(1, 100), b"RS1,100\r"),
            (gardasoft.continuous(8, 33.3), b"RS8,33.3\r"),
            (gardasoft.continuous(1, 0.0), b"RS1,0\r"),
            (gardasoft.switched(3, 5.5), b"RW3,5.5\r"),
            (gardasoft.pulse(1, 0.010, 0.00001, 250), b"RT1,10,0.01,250\r"),
            (gardasoft.pulse(1, 200e-6, 0.0015, 999, 0.004), b"RT1,0.2,1.5,999,4\r"),
            (gardasoft.trigger(1), b"TR1\r"),
            (gardasoft.trigger_input(1, 2), b"RP1,2\r"),
            (gardasoft.status(4), b"ST4\r"),
            (gardasoft.events(True), b"GT1\r"),
            (gardasoft.events(False), b"GT0\r"),
            (gardasoft.clear(), b"GR\r"),
        ],
    )
    def test_are_these_bytes(self, command, sent):
        assert gardasoft.line(command) == sent

    def test_are_joined_by_semicolons(self):
        assert gardasoft.line(b"VR", b"ST1") == b"VR;ST1\r"

    @given(st.floats(0, 1000), st.floats(1e-5, 1))
    def test_have_numbers_that_the_controller_reads(self, percent, width_s):
        text = gardasoft.pulse(1, width_s, 0.001, percent).decode()[4:]
        width, _, brightness = text.split(",")
        assert "e" not in text
        assert gardasoft.quantity(width, "time") == pytest.approx(width_s, abs=5.1e-7)
        assert gardasoft.quantity(brightness, "percent") == pytest.approx(percent, abs=5.1e-4)


class TestReplies:
    @pytest.mark.parametrize(
        ("wire", "reply"),
        [
            (b">", Reply(())),
            (b"RT420-20 (HW02) V031\r\n>", Reply(("RT420-20 (HW02) V031",))),
            (b"Err 1>", Reply((), (1,))),
            (b"Err 5\n\r>", Reply((), (5,))),
            (b"a\n\rErr 19\n\rb>", Reply(("a", "b"), (19,))),
            (b"Evt1,130>", Reply((), (), (Event(1, 130),))),
            (b"Evt1,128;Evt0,130\r\nErr 44\r\n>", Reply((), (44,), (Event(1, 128), Event(0, 130)))),
        ],
    )
    def test_are_output_errors_and_events(self, wire, reply):
        (raw,) = read(wire)
        assert gardasoft.parse_reply(raw) == reply

    def test_an_echo_of_the_command_is_no_output(self):
        assert gardasoft.parse_reply(b"RS1,50\r\nErr 19", b"RS1,50\r") == Reply((), (19,))
        assert gardasoft.parse_reply(b"RS1,5\r\n", b"RS1,50\r").lines == ("RS1,5",)

    @given(st.data(), st.lists(st.integers(0, 20), max_size=20))
    def test_events_anywhere_change_nothing_else(self, data, chunks):
        plain = b"RT860F-20 (HW02) V031\n\rErr 5\n\rCH 1, S 50.0%\n\r"
        wire, expected = plain, []
        for _ in range(data.draw(st.integers(0, 3))):
            code = data.draw(st.sampled_from([1, 44, 128, 140]))
            places = [n for n in range(len(wire) + 1) if b"Evt" not in wire[max(0, n - 12) : n + 12]]
            place = data.draw(st.sampled_from(places or [0]))
            event = b"Evt2,%d" % code + data.draw(st.sampled_from(TERMINATORS))
            wire = wire[:place] + event + wire[place:]
            expected.append(Event(2, code))
        (raw,) = read(wire + b">", chunks)
        reply = gardasoft.parse_reply(raw)
        assert (reply.lines, reply.errors) == (("RT860F-20 (HW02) V031", "CH 1, S 50.0%"), (5,))
        assert sorted(event.code for event in reply.events) == sorted(event.code for event in expected)

    @given(st.lists(st.binary(max_size=40), max_size=6), st.lists(st.integers(0, 30), max_size=10))
    def test_arrive_the_same_in_pieces_of_any_size(self, parts, chunks):
        parts = [part.replace(b">", b"") for part in parts]
        wire = b"".join(part + b">" for part in parts)
        assert read(wire, chunks) == read(wire) == parts

    @given(st.binary(max_size=300))
    def test_noise_is_one_error_and_no_other(self, noise):
        try:
            for raw in read(noise):
                reply = gardasoft.parse_reply(raw, b"ST1\r")
                assert all(line.isprintable() for line in reply.lines)
                gardasoft.parse_status(reply)
                gardasoft.parse_version(" ".join(reply.lines))
        except GardasoftError:
            pass

    def test_noise_in_the_text_is_refused(self):
        for noise in (b"RT\xff", b"RT\x07", b"\x00"):
            with pytest.raises(GardasoftError, match="no text"):
                gardasoft.parse_reply(noise)

    def test_a_stream_without_a_prompt_is_cut(self):
        reader = ReplyReader()
        for _ in range(4096 // 64):
            assert reader.feed(b"x" * 64) == []
        with pytest.raises(GardasoftError, match="4096"):
            reader.feed(b"x")
        assert reader.feed(b"VR>") == [b"VR"]

    def test_a_flush_keeps_events_and_the_beginning_of_one(self):
        reader = ReplyReader()
        reader.feed(b"noise Evt1,128\r\n noise Evt1,13")
        assert reader.flush() == (Event(1, 128),)
        (raw,) = reader.feed(b"0\r\nErr 44>")
        assert gardasoft.parse_reply(raw) == Reply((), (44,), (Event(1, 130),))

    @given(st.binary(max_size=60))
    def test_a_flush_leaves_nothing_but_the_beginning_of_an_event(self, noise):
        reader = ReplyReader()
        reader.feed(noise.replace(b">", b""))
        reader.flush()
        (raw,) = reader.feed(b">")
        assert raw == b"" or (raw.startswith(b"E") and len(raw) <= len(b"Evt12,128"))


class TestMeaning:
    def test_every_fatal_number_is_fatal_as_an_event_too(self):
        assert {40, 41, 44, 45, 46, 47} == gardasoft.FATAL_ERRORS
        for code in (*gardasoft.FATAL_ERRORS, 130, 131):
            assert Event(1, code).is_fatal
        for code in (1, 5, 19, 128, 129, 132, 140):
            assert not Event(1, code).is_fatal

    def test_events_say_what_they_mean(self):
        assert Event(1, 130).text == "event 130 of channel 1: over-temperature"
        assert Event(0, 44).text == "event 44: the controller is too hot"
        assert "unknown" in Event(1, 199).text

    def test_a_version_has_three_parts(self):
        assert gardasoft.parse_version("RT420-20 (HW02) V031") == Version("RT420-20", "HW02", "V031")
        for text in ("", "RT420-20", "CH 1, MD 0", "RT420-20 (HW02)"):
            with pytest.raises(GardasoftError, match="version"):
                gardasoft.parse_version(text)

    @pytest.mark.parametrize("text", STATUS)
    def test_a_status_is_read_by_its_keys(self, text):
        status = gardasoft.parse_status(Reply((text,)))
        assert gardasoft.quantity(status["S"], "percent") == 50
        assert gardasoft.quantity(status["RA"], "current") == pytest.approx(0.7)

    def test_a_status_without_keys_is_refused(self):
        for lines in ((), ("hello world",), ("123",)):
            with pytest.raises(GardasoftError, match="status"):
                gardasoft.parse_status(Reply(lines))

    @pytest.mark.parametrize(
        ("text", "kind", "value"),
        [
            ("0.1", "time", 1e-4),
            ("200us", "time", 2e-4),
            ("0.1s", "time", 0.1),
            ("20.00ms", "time", 0.02),
            ("100ma", "current", 0.1),
            ("2.45A", "current", 2.45),
            ("2.3", "current", 2.3),
            ("24.0V", "voltage", 24),
            ("50.0%", "percent", 50),
        ],
    )
    def test_numbers_have_the_manual_s_units(self, text, kind, value):
        assert gardasoft.quantity(text, kind) == pytest.approx(value)

    @pytest.mark.parametrize("text", ["", "A", "1e3", "1,5", "0x10", "nan", "2.3kA", "1 2", "--1"])
    def test_other_numbers_are_refused(self, text):
        with pytest.raises(GardasoftError, match="no current"):
            gardasoft.quantity(text, "current")

    @pytest.mark.parametrize(
        ("percent", "width_s", "duty"),
        [
            (0, 0.999, 1),
            (100, 0.999, 1),
            (100.1, 0.03, 0.3),
            (200, 0.03, 0.3),
            (300, 0.01, 0.2),
            (301, 0.002, 0.1),
            (500, 0.002, 0.1),
            (999, 0.001, 0.05),
        ],
    )
    def test_brighter_pulses_must_be_shorter_and_rarer(self, percent, width_s, duty):
        assert gardasoft.overdrive_limit(percent) == (width_s, duty)

    def test_nothing_is_brighter_than_a_thousand_percent(self):
        with pytest.raises(GardasoftError, match="1000"):
            gardasoft.overdrive_limit(1000.1)
