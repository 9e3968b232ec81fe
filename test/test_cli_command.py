
import pytest

from sim_bridge import cli
from vpsto_ros import __version__
from vpsto_ros.exceptions import InvalidInputError


def outcome(capsys, *arguments):
    with pytest.raises(SystemExit) as stopped:
        cli.main(arguments)
    return stopped.value.code, capsys.readouterr()


def test_help_shows_examples(capsys):
    code, text = outcome(capsys, "--help")
    assert code == 0
    for example in (
        "vpsto demo push_box",
        "--viewer",
        "vpsto experiment push_box --runs",
        "vpsto bench --json",
    ):
        assert example in text.out


def test_every_experiment_is_listed_with_a_line_about_it(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    code, text = outcome(capsys, "experiment", "--help")
    assert code == 0
    lines = text.out.partition("EXPERIMENT is one of these")[2].splitlines()[1:]
    listed = dict(line.split(maxsplit=1) for line in lines)
    assert max(map(len, lines)) <= 80
    assert listed == {name: choice.summary for name, choice in cli.EXPERIMENTS.items()}


def test_version(capsys):
    assert outcome(capsys, "--version")[1].out.strip() == f"vpsto {__version__}"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "required: COMMAND"),
        (("dmo",), "invalid choice: 'dmo'"),
        (("demo",), "required: DEMO"),
        (("demo", "push_bx"), "invalid choice: 'push_bx'"),
        (("demo", "push_box", "--duration", "-3"), "'-3' is not a positive number"),
        (("demo", "push_box", "--duration", "nan"), "'nan' is not a positive number"),
        (("demo", "push_box", "--real-time-factor", "0"), "'0' is not a positive number"),
        (("demo", "push_box", "--seed", "one"), "'one' is not a whole number"),
        (("experiment", "push_box", "--runs", "0"), "'0' is not a whole number from 1 up"),
        (("experiment", "push_box", "--runs", "2.5"), "'2.5' is not a whole number"),
        (("bench", "--jsn", "x"), "unrecognized arguments"),
    ],
)
def test_what_is_not_understood_exits_with_2_and_says_why(capsys, arguments, message):
    code, text = outcome(capsys, *arguments)
    assert code == 2
    assert message in text.err


def test_defaults_of_the_demo():
    arguments = ["demo", "push_box"]
    parsed = cli.build_parser(arguments).parse_args(arguments)
    assert (parsed.seed, parsed.duration, parsed.out) == (0, 90.0, "output/push_box")
    assert (parsed.viewer, parsed.real_time_factor) == (False, 1.0)


@pytest.mark.parametrize("name", sorted(cli.EXPERIMENTS))
def test_experiments_take_the_common_options(name):
    common = ["--runs", "3", "--seed", "5", "--out", "there", "--jobs", "2", "--resume"]
    arguments = ["experiment", name, *common]
    parsed = cli.build_parser(arguments).parse_args(arguments)
    assert (parsed.runs, parsed.seed, parsed.out) == (3, 5, "there")
    assert (parsed.jobs, parsed.scheduler, parsed.resume) == (2, None, True)


def test_errors_of_the_package_are_messages_not_tracebacks(capsys, monkeypatch):
    def fail(_arguments):
        raise InvalidInputError("the table is not flat")

    monkeypatch.setattr("sim_bridge.bench.run", fail)
    assert cli.main(["bench"]) == 1
    assert capsys.readouterr().err == "vpsto: error: the table is not flat\n"


def test_a_missing_python_package_comes_with_its_remedy(capsys, monkeypatch):
    def missing(_module):
        raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")

    monkeypatch.setattr(cli.importlib, "import_module", missing)
    assert cli.main(["bench"]) == 1
    assert "'mujoco' is missing" in capsys.readouterr().err
