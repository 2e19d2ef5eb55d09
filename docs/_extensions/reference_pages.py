"""Pages of the reference that are made from the program: subpackages and the command line."""

import inspect
import re
from importlib import import_module
from pathlib import Path

import perrin

# Those of the command line and of the paper's figures are no interface.
SUBPACKAGES = tuple(name for name in perrin._FACES if name not in ("cli", "paper", "compiled"))
# Subpackages without names in `perrin` itself whose functions users call.
CALLED_BY_PATH = ("plot",)


def write_if_changed(path, text):
    """Write a page, unless it has this text: Sphinx reads again what is newer."""
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def title(text, mark="="):
    """Return a heading of reStructuredText."""
    return f"{text}\n{mark * len(text)}\n"


def summary(names, *, pages):
    """Return a table of names with their first sentences, which link to pages of their own."""
    options = "   :toctree: generated\n" if pages else ""
    return f".. autosummary::\n{options}   :nosignatures:\n\n" + "".join(
        f"   {name}\n" for name in names
    )


def subpackage_page(name):
    """Return the page of a subpackage: classes, functions, and names of its inside."""
    module = import_module(f"perrin.{name}")
    inside = getattr(module, "__all__", [key for key in vars(module) if not key.startswith("_")])
    inside = [key for key in inside if callable(getattr(module, key))]
    called = list(perrin._FACES.get(name, ())) or (inside if name in CALLED_BY_PATH else [])
    prefix = "perrin" if name not in CALLED_BY_PATH else f"perrin.{name}"
    classes = [key for key in called if inspect.isclass(getattr(module, key))]
    functions = [key for key in called if key not in classes]
    further = [key for key in inside if key not in called]
    text = [title(f"perrin.{name}"), inspect.getdoc(module) or "", ""]
    for heading, names in (("Classes", classes), ("Functions", functions)):
        if names:
            text += [title(heading, "-"), summary([f"{prefix}.{key}" for key in names], pages=True)]
    if further:
        text += [
            title("Inside the subpackage", "-"),
            f"Names that other parts of perrin use, as ``perrin.{name}.NAME``. They are documented "
            "in their docstrings, and may change between releases.\n",
            summary([f"perrin.{name}.{key}" for key in further], pages=False),
        ]
    return "\n".join(text)


def reference_index():
    """Return the first page of the Python reference: all subpackages, and all public names."""
    text = [
        title("Python"),
        "Every name below is available as ``perrin.NAME``, and is imported from its subpackage "
        "when it is first used. Lengths are in um, times in s, angles in rad, temperatures in K, "
        "viscosities in Pa s (:doc:`/conventions`).\n",
        ".. toctree::\n   :hidden:\n\n" + "".join(f"   {name}\n" for name in SUBPACKAGES),
    ]
    for name in SUBPACKAGES:
        face = perrin._FACES.get(name, ())
        first = (inspect.getdoc(import_module(f"perrin.{name}")) or "").split("\n\n")[0]
        text += [title(f"perrin.{name}", "-"), f"{first} :doc:`All of it <{name}>`.\n"]
        if face:
            text.append(summary([f"perrin.{key}" for key in face], pages=False))
    return "\n".join(text)


def option_rows(command, name):
    """Return the options of a command by group, as its help shows them."""
    context = command.make_context(name, [], resilient_parsing=True)
    groups = {}
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        group = getattr(parameter, "rich_help_panel", None) or "Other options"
        if parameter.param_type_name == "argument":
            group = "Arguments"
        if record is not None and "--help" not in parameter.opts:
            groups.setdefault(group, []).append(record)
    return groups


def command_section(name, command, level=2):
    """Return the sections of a command, and of the commands of a group."""
    text = [f"{'#' * level} {name}\n", inspect.cleandoc(command.help or "") + "\n"]
    if hasattr(command, "commands"):
        for part, inner in command.commands.items():
            text += command_section(f"{name} {part}", inner, level + 1)
        return text
    if command.epilog:
        lines = [line.strip() for line in command.epilog.splitlines() if line.strip()]
        text.append("```sh\n" + "\n".join(lines) + "\n```\n")
    for group, rows in option_rows(command, name).items():
        text.append(f"| {group} | |\n|---|---|")
        for spelling, meaning in rows:
            meaning = re.sub(r"([|<>*_])", r"\\\1", " ".join(meaning.split()))
            text.append(f"| `{spelling}` | {meaning} |")
        text.append("")
    return text


def command_line_page():
    """Return the page of all commands, in Markdown."""
    from typer.main import get_command

    from perrin.cli.app import app

    text = [
        "# Command line\n",
        "This page is made from the program itself. `perrin COMMAND --help` prints the same, and "
        "`perrin --install-completion` adds completion of options to your shell.\n",
    ]
    for name, command in get_command(app).commands.items():
        text += command_section(f"perrin {name}", command)
    return "\n".join(text)


def write_pages(app, _):
    """Write all generated pages into docs/reference."""
    folder = Path(app.srcdir, "reference")
    write_if_changed(folder / "python" / "index.rst", reference_index())
    for name in SUBPACKAGES:
        write_if_changed(folder / "python" / f"{name}.rst", subpackage_page(name))
    write_if_changed(folder / "command-line.md", command_line_page())


def setup(app):
    """Register the pages; they are written before Sphinx lists the files that it reads."""
    app.connect("config-inited", write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
