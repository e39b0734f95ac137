"""Commands, as their help describes them."""

import re
from collections.abc import Iterator

from cyclopts import App
from cyclopts.docs.markdown import generate_markdown_docs
from docstrings import linked

from faintfield.pipelines.launcher import app

# Groups of `faintfield --help`, and the page of each.
PAGES = {
    "Try it without hardware": "simulation",
    "At the rig": "rig",
    "Calibrate": "calibration",
    "Reconstruct": "reconstruction",
    "Other people's files": "exchange",
}


def command_list() -> str:
    """Return the list of all commands by group, with links to their help, and the options that all share."""
    text = generate_markdown_docs(app, recursive=False, generate_toc=False)
    _, *groups = re.split(r"^\*\*(.+)\*\*:$", text.partition("\n## ")[0], flags=re.MULTILINE)
    sections = zip(groups[::2], groups[1::2], strict=True)
    return "\n".join(f"## {group}\n{entries}" for group, entries in sections)


def command_group(page: str) -> str:
    """Return the help of all commands of one page."""
    names = [name for name in app.resolved_commands() if not name.startswith("-") and PAGES[_group(name)] == page]
    return "\n".join(text for name in _in_order(app, names) for text in _help(app[name], (name,)))


def _group(name: str) -> str:
    groups = app[name].group
    group = groups[0] if isinstance(groups, tuple) else groups
    return group if isinstance(group, str) else group.name


def _in_order(parent: App, names: list[str]) -> list[str]:
    return sorted(names, key=lambda name: parent[name].sort_key or 0)


def _help(command: App, chain: tuple[str, ...]) -> Iterator[str]:
    """Yield the help of a command with its example, then that of its own commands."""
    with app.app_stack(list(chain)):
        text = generate_markdown_docs(
            command,
            recursive=False,
            generate_toc=False,
            heading_level=1 + len(chain),
            command_chain=["faintfield", *chain],
        )
    names = [name for name in command.resolved_commands() if not name.startswith("-")]
    yield f"({'-'.join(('faintfield', *chain))})=\n"
    yield _edited(re.split(r"^#{3,} ", text, flags=re.MULTILINE)[0] if names else text)
    if command.help_epilogue and not names:
        yield f"**Example**:\n\n```sh\n{command.help_epilogue.removeprefix('Example: ')}\n```\n"
    for name in _in_order(command, names):
        yield from _help(command[name], (*chain, name))


def _edited(text: str) -> str:
    """Return help with options as terms and their descriptions, without what goes without saying."""
    text = (
        text.replace(" *[default: False]*", "")
        .replace("**Parameters**", "**Options**")
        .split("\n**Every command**:")[0]
    )
    return linked(re.sub(r"^\* (`[^`\]]+`): ", r"\n\1\n: ", text, flags=re.MULTILINE))
