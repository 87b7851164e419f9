"""Scripts that complete commands, options and values in a shell.

The scripts contain all names, so that a completion does not start Python: typer's own scripts call
the program for each completion, which takes seconds because its options have to be imported. A
script belongs to the version that printed it.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

PROGRAM = "collocation-sysid"
FUNCTION = "_collocation_sysid"
# Longest description in a menu [characters].
LONGEST_DESCRIPTION = 70


@dataclass(frozen=True)
class CompletedOption:
    """Option of a command.

    Attributes
    ----------
    names : tuple of str
        Such as "--json", or "--quiet" and "-q".
    description : str
    takes_value : bool
    values : tuple of str
        Possible values; empty if the value is a file or free text.
    """

    names: tuple[str, ...]
    description: str
    takes_value: bool
    values: tuple[str, ...]


@dataclass(frozen=True)
class CompletedCommand:
    """Command with its options.

    Attributes
    ----------
    name : str
    description : str
    options : tuple of CompletedOption
    arguments : tuple of str
        Possible values of the arguments; empty if they are files or free text.
    """

    name: str
    description: str
    options: tuple[CompletedOption, ...]
    arguments: tuple[str, ...]


def completion_script(shell: str, root: Any) -> str:
    """Return the script of a shell.

    Parameters
    ----------
    shell : {"bash", "zsh", "fish"}
    root : Group
        Typer's group of all commands; its modules are imported.
    """
    context = root.make_context(PROGRAM, ["schema"], resilient_parsing=True)
    values = named_values()
    commands = [
        _completed_command(root.get_command(context, name), context, values=values.get(name, {}))
        for name in root.list_commands(context)
    ]
    return SCRIPTS[shell](commands, _options(root, context, values={}))


def named_values() -> dict[str, dict[str, tuple[str, ...]]]:
    """Return the possible values of options and arguments whose type is text, by command and by
    parameter of its function.
    """
    from ..common.pages import page_files
    from ..extras.export import MAIN_FILES
    from ..methods import METHODS

    return {
        "solve": {"method": tuple(METHODS)},
        "methods": {"name": tuple(METHODS)},
        "explain": {"topics": tuple(page_files())},
        "export": {"to": tuple(MAIN_FILES)},
    }


def _completed_command(
    command: Any, context: Any, values: Mapping[str, tuple[str, ...]]
) -> CompletedCommand:
    """Return a command of typer with its options."""
    arguments = [p for p in command.get_params(context) if p.param_type_name == "argument"]
    known = (_values(argument, context, values=values) for argument in arguments)
    return CompletedCommand(
        name=command.name,
        description=_summary(command.help or ""),
        options=_options(command, context, values=values),
        arguments=tuple(value for each in known for value in each),
    )


def _options(
    command: Any, context: Any, values: Mapping[str, tuple[str, ...]]
) -> tuple[CompletedOption, ...]:
    """Return the options of a command that help shows; one with a negation, such as --no-pictures,
    yields two.
    """
    options = []
    for parameter in command.get_params(context):
        if parameter.param_type_name != "option" or parameter.hidden:
            continue
        known = () if parameter.is_flag else _values(parameter, context, values=values)
        for names in filter(None, (parameter.opts, parameter.secondary_opts)):
            options.append(
                CompletedOption(
                    names=tuple(names),
                    description=_summary(parameter.help or ""),
                    takes_value=not parameter.is_flag,
                    values=known,
                )
            )
    return tuple(options)


def _values(parameter: Any, context: Any, values: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """Return the possible values of a parameter: those in `values`, else those that its type lists;
    empty for files and free text.
    """
    if parameter.name in values:
        return values[parameter.name]
    items = parameter.shell_complete(context, "")
    return tuple(str(each.value) for each in items if each.type == "plain" and each.value)


def _summary(text: str) -> str:
    """Return the first sentence of a help text without its full stop, on one line, shortened with
    an ellipsis to `LONGEST_DESCRIPTION` for a menu.
    """
    first = re.split(r"(?<=[a-z)])\.(?:\s|$)|\n\n", text.strip(), maxsplit=1)[0]
    line = " ".join(first.split())
    if len(line) <= LONGEST_DESCRIPTION:
        return line
    return line[: LONGEST_DESCRIPTION - 1].rsplit(" ", 1)[0].rstrip(",;:") + "…"


def bash_script(commands: Sequence[CompletedCommand], root: Sequence[CompletedOption]) -> str:
    """Return the script for bash, which defines the completion when it is sourced; values that are
    not known are completed as files.

    Parameters
    ----------
    commands : sequence of CompletedCommand
    root : sequence of CompletedOption
        Options that come before a command.
    """
    first = [*(each.name for each in commands), *_names(root)]
    lines = [
        f"# Completion of {PROGRAM} for bash.",
        f"{FUNCTION}() {{",
        '    local current="${COMP_WORDS[COMP_CWORD]}"',
        '    local previous="${COMP_WORDS[COMP_CWORD-1]}"',
        '    local command="${COMP_WORDS[1]}" known=""',
        "    COMPREPLY=()",
        "    if (( COMP_CWORD == 1 )); then",
        f"        known={shlex.quote(' '.join(first))}",
        "    else",
        '        case "$command $previous" in',
    ]
    for command in commands:
        for option in command.options:
            if option.takes_value:
                patterns = "|".join(f'"{command.name} {name}"' for name in option.names)
                words = shlex.quote(" ".join(option.values))
                reply = (
                    f'COMPREPLY=($(compgen -W {words} -- "$current")); ' if option.values else ""
                )
                lines.append(f"            {patterns}) {reply}return ;;")
    lines += ["        esac", '        case "$command" in']
    for command in commands:
        options = shlex.quote(" ".join(_names(command.options)))
        arguments = shlex.quote(" ".join(command.arguments))
        lines.append(
            f'            {command.name}) [[ "$current" == -* ]] && known={options} '
            f"|| known={arguments} ;;"
        )
    lines += [
        "        esac",
        "    fi",
        '    [[ -n "$known" ]] && COMPREPLY=($(compgen -W "$known" -- "$current"))',
        "    return 0",
        "}",
        f"complete -o default -F {FUNCTION} {PROGRAM}",
    ]
    return "\n".join(lines)


def zsh_script(commands: Sequence[CompletedCommand], root: Sequence[CompletedOption]) -> str:
    """Return the script for zsh, to be evaluated, or put into a folder of ``fpath``; arguments as
    of `bash_script`.
    """
    lines = [
        f"#compdef {PROGRAM}",
        f"{FUNCTION}() {{",
        "    local -a known",
        "    if (( CURRENT == 2 )); then",
        "        known=(",
        *(f"            {_described(each.name, each.description)}" for each in commands),
        *(f"            {_described(o.names[0], o.description)}" for o in root),
        "        )",
        "        _describe command known",
        "        return",
        "    fi",
        "    local command=$words[2]",
        "    shift words",
        "    (( CURRENT-- ))",
        '    case "$command" in',
    ]
    for command in commands:
        lines.append(f"        {command.name}) _arguments \\")
        lines += [
            f"            {_zsh_option(name, option)} \\"
            for option in command.options
            for name in option.names
        ]
        action = f"({' '.join(command.arguments)})" if command.arguments else "_files"
        lines.append(f"            {shlex.quote(f'*:argument:{action}')} ;;")
    lines += [
        "    esac",
        "}",
        "if [[ $zsh_eval_context[-1] == loadautofunc ]]; then",
        f'    {FUNCTION} "$@"',
        "else",
        f"    compdef {FUNCTION} {PROGRAM}",
        "fi",
    ]
    return "\n".join(lines)


def _described(name: str, description: str) -> str:
    """Return an entry of a menu of zsh, "name:description", quoted for the shell."""
    return shlex.quote(f"{name}:{description}")


def _zsh_option(name: str, option: CompletedOption) -> str:
    """Return the specification of one name of an option for `_arguments`, quoted; the option may
    occur repeatedly.
    """
    text = re.sub(r"([\[\]\\:])", r"\\\1", option.description)
    value = ""
    if option.takes_value:
        value = ":value:" + (f"({' '.join(option.values)})" if option.values else "_files")
    return shlex.quote(f"*{name}[{text}]{value}")


def fish_script(commands: Sequence[CompletedCommand], root: Sequence[CompletedOption]) -> str:
    """Return the script for fish, which defines the completion when it is sourced; arguments as of
    `bash_script`.
    """
    begin = f"complete -c {PROGRAM}"
    lines = [f"# Completion of {PROGRAM} for fish."]
    for option in root:
        lines.append(f"{begin} -n __fish_use_subcommand {_fish_option(option)}")
    for command in commands:
        text = _fish_quote(command.description)
        lines.append(f"{begin} -n __fish_use_subcommand -f -a {command.name} -d {text}")
        condition = f"-n {_fish_quote(f'__fish_seen_subcommand_from {command.name}')}"
        if command.arguments:
            values = _fish_quote(" ".join(command.arguments))
            lines.append(f"{begin} {condition} -f -a {values}")
        lines += [f"{begin} {condition} {_fish_option(option)}" for option in command.options]
    return "\n".join(lines)


def _fish_option(option: CompletedOption) -> str:
    """Return the arguments of fish's `complete` for an option: its names, its values (files if
    these are not known) and its description.
    """
    names = [f"-l {n[2:]}" if n.startswith("--") else f"-s {n[1:]}" for n in option.names]
    value = ""
    if option.takes_value:
        value = f" -x -a {_fish_quote(' '.join(option.values))}" if option.values else " -r -F"
    return f"{' '.join(names)}{value} -d {_fish_quote(option.description)}"


def _fish_quote(text: str) -> str:
    """Return a text in single quotes of fish, which knows two escapes within them."""
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"


def _names(options: Sequence[CompletedOption]) -> list[str]:
    """Return all names of options, in their order."""
    return [name for option in options for name in option.names]


SCRIPTS: dict[str, Callable[[Sequence[CompletedCommand], Sequence[CompletedOption]], str]] = {
    "bash": bash_script,
    "zsh": zsh_script,
    "fish": fish_script,
}
