"""Messages at the command line name options, never arguments of Python."""

from __future__ import annotations

import functools
import inspect
import re
from pathlib import Path

import pytest

import perrin
from command_line import command_line
from perrin.cli import app as cli
from perrin.cli.messages import in_options, options_of

SOURCE = Path(perrin.__file__).parent
COMMANDS = {
    cli.analyze: (perrin.analyze, perrin.read_tracks),
    cli.run: (perrin.analyze_stack, perrin.open_stack),
    cli.simulate: (perrin.simulate_motion, perrin.add_noise),
    cli.predict: (perrin.cluster_mobility,),
    cli.plan: (perrin.plan_sampling,),
    cli.convert: (perrin.read_tracks,),
}
# Arguments that the command line sets by itself, or takes as words without an option.
WITHOUT_OPTION = {
    "cluster", "degree", "experiment", "keep", "path", "positions", "progress", "radius",
    "rng", "scheme", "settings", "spots", "stack", "tracks", "work", "detections",
}  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: c.__name__)
def test_every_argument_has_its_option(command):
    """An argument that a message can name is an option of the command, or is set by it."""
    options = options_of(command)
    for function in COMMANDS[command]:
        unknown = set(inspect.signature(function).parameters) - set(options) - WITHOUT_OPTION
        assert not unknown, function.__name__
    assert set(options.values()) <= {f"--{name}" for name in words_of(command)}


def words_of(command) -> set[str]:
    """Return the options that the help of a command offers."""
    from click.testing import CliRunner

    result = CliRunner().invoke(command_line, [command.__name__, "--help"], env={"COLUMNS": "200"})
    return set(re.findall(r"--([a-z][a-z-]*)", result.output))


@pytest.mark.parametrize(
    ("command", "python", "shell"),
    [
        (
            cli.analyze,
            "missing column frame; rename them, or state columns={'frame': ...} with the number",
            "missing column frame; rename them, or state --columns frame=... with the number",
        ),
        (
            cli.analyze,
            'for example columns={"x": 0, "y": 1, "frame": -2}',
            "for example --columns x=0,y=1,frame=-2",
        ),
        (cli.convert, "choose one: columns={'x': 'x (um)'}", "choose one: --columns x=x (um)"),
        (cli.analyze, "t.csv: scale: expected 3", "t.csv: --scale: expected 3"),
        (cli.analyze, "state scale=0.001, or correct", "state --scale 0.001, or correct"),
        (cli.analyze, "state scale=(0.1, 0.1, 0.3)", "state --scale 0.1,0.1,0.3"),
        (
            cli.analyze,
            "dt: expected > 0, got 0; contact: expected > 0",
            "--dt: expected > 0, got 0; --contact: expected > 0",
        ),
        (cli.analyze, "loose at contact = 2.0 um", "loose at --contact 2.0 um"),
        (cli.analyze, "r exists: or overwrite=True", "r exists: or --overwrite"),
        (cli.run, "pass voxel=(z, y, x) in um", "pass --voxel z,y,x in um"),
        (cli.run, "pass dt= in s", "pass --dt in s"),
        (cli.run, "pass image= (a name)", "pass --image (a name)"),
        (cli.run, "not planes=3; pass channel=0 to 2", "not --planes 3; pass --channel 0 to 2"),
        (
            cli.run,
            "pass refine=None, or refine='trackpy' where",
            "pass --refine none, or --refine trackpy where",
        ),
        (cli.run, "another folder, or anew=True", "another folder, or --overwrite"),
        (cli.run, "histogram and set minmass", "histogram and set --minmass"),
        (cli.run, "plane_time 0.1 (in the file 0.2)", "--plane-time 0.1 (in the file 0.2)"),
        (
            cli.plan,
            "expected a finite number > 0: D_R = -1.0, total_time = 0.0; n_frames: 3",
            "expected a finite number > 0: --d-r -1.0, --time 0.0; --frames: 3",
        ),
        (cli.plan, "photons: expected n_frames", "--photons: expected --frames"),
        (cli.predict, "centers: spheres 0 and 1", "--positions: spheres 0 and 1"),
        (cli.simulate, "D_T: expected >= 0", "--d-t: expected >= 0"),
    ],
)
def test_messages_are_translated(command, python, shell):
    """Dictionaries, tuples, True, None and renamed arguments become what one types."""
    assert in_options(python, options_of(command)) == shell


@pytest.mark.parametrize(
    "text",
    [
        "4 D_R dt = 0.21 over 0.2: whole turns between frames",
        "identities are unsafe at dt = 0.5 s; they are safe below dt = 0.1 s",
        "not resolved: D_R = 0.0051(4) rad^2/s [mle, 300 frames]",
        "D_T: 19 steps, fewer than 30: the interval is approximate",
        "noise floor: the steps show Phi^2 = 0.1 +- 0.2 rad^2",
        "z scale: the shape changes with its orientation",
        "3 of 60 frames have no pose",
    ],
)
def test_statements_about_data_stay(text):
    """What names a quantity, not an argument, is left alone."""
    assert in_options(text, options_of(cli.analyze)) == text


@functools.cache
def literals() -> tuple[str, ...]:
    """Return every text in the library's code but docstrings, in the parts between its values.

    They are read by patterns: to compile the source would take five times as long.
    """
    found = []
    for path in SOURCE.rglob("*.py"):
        if path.relative_to(SOURCE).parts[0] != "cli":
            code = re.sub(
                r'r?"""[\s\S]*?"""|^ *#.*', "", path.read_text("utf-8"), flags=re.MULTILINE
            )
            for line in re.findall(r'"(?:[^"\\\n]|\\.)*"|\'(?:[^\'\\\n]|\\.)*\'', code):
                found += re.split(r"\{[^{}]*\}", line[1:-1])
                for value in re.findall(r"\{[^{}]*\}", line[1:-1]):
                    found += re.findall(r"'([^']*)'", value)
    return tuple(text for text in found if re.search(r"[ =]", text))


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: c.__name__)
def test_no_message_of_the_source_keeps_an_argument(command):
    """Of all texts in the source none names an argument of the command in Python's way."""
    options = options_of(command)
    names = "|".join(options)
    python = re.compile(rf"(?<![\w-])(?:{names})=|^(?:{names}): (?=expected|needed|unknown)")
    texts = literals()
    assert len(texts) > 300
    named = [text for text in texts if python.search(text)]
    if command in (cli.analyze, cli.run, cli.plan):
        assert len(named) > 3
    for text in named:
        assert not python.search(in_options(text, options)), text
        assert "--" in in_options(text, options)


def test_no_message_of_the_library_names_an_option():
    """A message names arguments; the command line translates them."""
    assert [text for text in literals() if re.search(r"(?<![\w-])--[a-z]", text)] == []


@pytest.mark.parametrize(
    ("command", "headings"),
    [
        (
            cli.analyze,
            ["Arguments", "Input", "Noise and estimates",
             "Sizes and predictions", "Work", "Output"],
        ),
        (
            cli.run,
            ["Arguments", "Input", "Spheres and clusters", "Noise and estimates",
             "Sizes and predictions", "Work", "Output"],
        ),
        (cli.predict, ["Arguments", "Body and motion", "Sizes and predictions", "Output"]),
        (cli.simulate, ["Arguments", "Body and motion", "Recording", "Output"]),
        (cli.plan, ["Arguments", "Body and motion", "Recording", "Output"]),
        (cli.convert, ["Arguments", "Input", "Output"]),
    ],
)  # fmt: skip
def test_many_options_are_shown_in_groups(command, headings):
    """Every option is in one group of the help, under its heading."""
    from click.testing import CliRunner

    text = CliRunner().invoke(command_line, [command.__name__, "--help"]).output
    shown = re.findall(r"^(\w[\w ]*):$", text, re.MULTILINE)
    other = ("Other options", "Examples")
    assert [heading for heading in shown if heading not in other] == headings
    assert f"Examples:\n  perrin {command.__name__} " in text
    options = re.findall(r"^  (?:-o, )?(--[a-z][a-z-]*)", text, re.MULTILINE)
    assert sorted(options) == sorted({*options_of(command).values(), "--help"})
