"""Passwords in URLs are neither printed nor logged."""

import json

import pytest
from arithmetic import task

from steadylight.engines.in_process import InProcess
from steadylight.redaction import redacted

URL = "sftp://me:hunter2@host/runs/walk"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (URL, "sftp://me:***@host/runs/walk"),
        (f"{URL}: cannot be read (Error: '{URL}')", "sftp://me:***@host/runs/walk: cannot be read (Error: "),
        ("s3://key:p@ss:word@bucket/a", "s3://key:***@bucket/a"),
        ("ftp://:secret@host", "ftp://:***@host"),
        ("tcp://10.0.0.1:8786 and a@b", "tcp://10.0.0.1:8786 and a@b"),
        ("https://host:80/me:you@there", "https://host:80/me:you@there"),
    ],
)
def test_only_the_password_is_left_out(text, shown):
    assert redacted(text).startswith(shown)
    assert "hunter2" not in redacted(text)


def test_the_journal_gets_no_password(tmp_path):
    def fail(_):
        raise OSError(f"{URL}: no route to host")

    seen = []
    with InProcess(attempts=2) as engine, pytest.raises(Exception, match="task a-1 failed") as caught:
        seen.extend(engine.run([task("a-1")], fail))
    assert "hunter2" not in f"{caught.value} {caught.value.details}"
    assert "***" in str(caught.value)
    with InProcess(attempts=2) as engine:
        attempt = next(iter(engine.run([task("a-1")], fail)))
    assert "hunter2" not in json.dumps(attempt.result)


def test_a_message_of_the_command_shows_no_password(monkeypatch, capsys):
    from steadylight import cli

    for debug in ([], ["--debug"]):
        monkeypatch.setattr("sys.argv", ["steadylight", *debug, "render", "gallery", "--output", URL])
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert end.value.code == 2
        said = capsys.readouterr()
        assert "sftp://me:***@host/runs/walk" in said.err
        assert "hunter2" not in said.out + said.err
