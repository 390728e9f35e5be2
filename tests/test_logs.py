import logging
import sys

from daemon.logs import LineFormatter, log, under_journal


def lines(journal, level, sentence, **fields):
    logger = logging.Logger("surfclass.test")
    kept = []

    class Keep(logging.Handler):
        def emit(self, record):
            kept.append(self.format(record))

    handler = Keep()
    handler.setFormatter(LineFormatter(journal))
    logger.addHandler(handler)
    if fields.pop("trace", False):
        try:
            raise ValueError("broken")
        except ValueError:
            logger.exception(sentence)
    else:
        log(logger, level, sentence, **fields)
    return kept[0].split("\n")


def test_priority_and_fields():
    assert lines(True, logging.WARNING, "capture rejected", name="c1", ms=1.23456789, why='a "b" c') == [
        '<4>capture rejected name=c1 ms=1.23457 why="a \\"b\\" c"'
    ]


def test_every_line_of_a_traceback_has_the_priority():
    told = lines(True, logging.ERROR, "boom", trace=True)
    assert len(told) > 2
    assert all(line.startswith("<3>") for line in told)
    assert told[-1] == "<3>ValueError: broken"


def test_a_list_of_faults_stays_one_line():
    assert lines(True, logging.ERROR, "x", error="a:\n  b: missing\n  c: missing") == [
        '<3>x error="a:\\n  b: missing\\n  c: missing"'
    ]
    assert lines(True, logging.ERROR, "a:\n  b: missing") == ["<3>a: | b: missing"]


def test_people_get_no_priority():
    told = lines(False, logging.INFO, "ready", health="ok")
    assert told[0].endswith("INFO    ready health=ok")


def test_journal_is_recognised_by_device_and_inode(monkeypatch, tmp_path):
    with (tmp_path / "log").open("w") as stream:
        import os

        status = os.fstat(stream.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
        assert under_journal(stream)
        assert not under_journal(sys.__stdin__)
