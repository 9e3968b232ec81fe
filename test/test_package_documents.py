"""What README and doc/ show is what the package does: code runs, commands are understood."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from sim_bridge import cli

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "doc").glob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"(?:[\w./]+/)?vpsto (.+)")


def commands(text):
    """Arguments of every `vpsto` command: a code span or a line of a code block that begins with it."""
    lines = [line for _, block in FENCE.findall(text) for line in block.splitlines()]
    spans = re.findall(r"`([^`\n]+)`", FENCE.sub("", text))
    for code in lines + spans:
        if found := COMMAND.match(code.strip()):
            yield tuple(shlex.split(found[1], comments=True))


NAMED = sorted({command for document in DOCUMENTS for command in commands(document.read_text())})


def test_commands_are_found_in_spans_and_blocks():
    block = "```\nvpsto e 'f g'  # why\nls vpsto h\n```\n"
    text = f"`vpsto a --b`, `.venv/bin/vpsto c` not `vpsto`, vpsto d\n{block}"
    assert set(commands(text)) == {("a", "--b"), ("c",), ("e", "f g")}
    assert len(NAMED) > 10


@pytest.mark.parametrize("arguments", NAMED, ids=" ".join)
def test_every_command_named_is_understood(arguments, capsys):
    try:
        cli.build_parser(arguments).parse_args(arguments)
    except SystemExit as stopped:
        assert stopped.code == 0, capsys.readouterr().err


def test_every_experiment_is_in_the_table_of_results():
    section = README.partition("## How good is it?")[2].partition("\n## ")[0]
    table = "\n".join(line for line in section.splitlines() if line.startswith("|"))
    named = {command[1] for command in commands(table) if command[0] == "experiment"}
    assert named == set(cli.EXPERIMENTS)


def test_the_python_code_runs_as_printed(tmp_path):
    blocks = [code for language, code in FENCE.findall(README) if language == "python"]
    assert blocks
    for code in blocks:
        command = [sys.executable, "-W", "error::RuntimeWarning", "-c", code]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
        assert run.returncode == 0, run.stderr
        assert len(run.stdout.splitlines()) == code.count("print(")


@pytest.mark.parametrize("document", [ROOT / "README.md", *sorted((ROOT / "doc").glob("*.md"))], ids=str)
def test_every_file_linked_is_there(document):
    links = re.findall(r"\]\((?!https?:|#)([^)\s]+)\)", document.read_text())
    missing = [link for link in links if not (document.parent / link).exists()]
    assert not missing
