"""Completion scripts, run by their shells."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from kit.problem_files import run_command

from collocation_sysid.cli.shell_completion import (
    CompletedCommand,
    CompletedOption,
    bash_script,
    fish_script,
    zsh_script,
)


def need(shell: str) -> str:
    path = shutil.which(shell)
    if path is None:
        pytest.skip(f"{shell} is not installed")
    return path


def run_shell(*words: object) -> str:
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("completion")
    files = {}
    for shell in ("bash", "zsh", "fish"):
        outcome = run_command("completion", shell)
        assert (outcome.code, outcome.err) == (0, "")
        files[shell] = folder / shell
        files[shell].write_text(outcome.out)
    return files


def complete_in_bash(script: Path, line: str) -> list[str]:
    words = line.split(" ")
    array = " ".join(f"'{word}'" for word in words)
    program = f"source {script}; COMP_WORDS=({array}); COMP_CWORD={len(words) - 1}; "
    program += '_collocation_sysid; printf "%s\\n" "${COMPREPLY[@]}"'
    return run_shell(need("bash"), "--norc", "-c", program).split()


def complete_in_fish(script: Path, line: str) -> list[str]:
    shown = run_shell(need("fish"), "--no-config", "-c", f"source {script}; complete -C '{line}'")
    return [each.split("\t")[0] for each in shown.splitlines()]


COMPLETERS = {"bash": complete_in_bash, "fish": complete_in_fish}


@pytest.mark.parametrize("shell", [*COMPLETERS])
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("collocation-sysid so", ["solve"]),
        ("collocation-sysid doc", ["doctor"]),
        ("collocation-sysid solve --no-p", ["--no-pictures"]),
        ("collocation-sysid solve --method redu", ["reduced-space"]),
        ("collocation-sysid new silicone --kind ", ["compression", "specimen", "swing", "tension"]),
        ("collocation-sysid explain verd", ["verdict"]),
        ("collocation-sysid export runs/a --to usd", ["usd"]),
        ("collocation-sysid completion z", ["zsh"]),
    ],
)
def test_a_shell_completes(scripts, shell, line, expected):
    assert sorted(COMPLETERS[shell](scripts[shell], line)) == expected


@pytest.mark.parametrize("shell", [*COMPLETERS])
def test_files_are_completed_where_no_values_are_known(scripts, shell, tmp_path, monkeypatch):
    (tmp_path / "problem.toml").write_text("")
    monkeypatch.chdir(tmp_path)
    found = COMPLETERS[shell](scripts[shell], "collocation-sysid solve prob")
    # bash itself completes files where the function finds nothing.
    assert found == ([] if shell == "bash" else ["problem.toml"])
    assert "complete -o default" in scripts["bash"].read_text()


def test_zsh_offers_commands_options_and_values(scripts):
    zsh = need("zsh")
    run_shell(zsh, "-f", "-n", scripts["zsh"])
    # The functions of zsh's completion system print what they are called with.
    stubs = "compdef() { }; _describe() { print -l $known }; _arguments() { print -l -- $@ }; "

    def called(line: str) -> list[str]:
        words = line.split(" ")
        array = " ".join(f"'{word}'" for word in words)
        program = f"{stubs} source {scripts['zsh']}; words=({array}); CURRENT={len(words)}; "
        return run_shell(zsh, "-f", "-c", program + "_collocation_sysid").splitlines()

    commands = called("collocation-sysid so")
    assert any(each.startswith("solve:Identify the parameters") for each in commands)
    options = called("collocation-sysid solve --m")
    (method,) = [each for each in options if each.startswith("*--method[")]
    assert method.endswith(":value:(" + method.rpartition("(")[2])
    assert "reduced-space" in method
    assert options[-1] == "*:argument:_files"
    assert called("collocation-sysid completion ")[-1] == "*:argument:(bash zsh fish)"


def test_every_option_of_every_command_is_in_every_script(scripts):
    texts = {shell: file.read_text() for shell, file in scripts.items()}
    for words in ("solve", "study", "explain", "doctor"):
        shown = run_command(words, "--help")
        if shown.code:
            continue
        options = {w.strip(",") for w in shown.out.split() if w.startswith("--")} - {"--"}
        for option in options:
            assert option in texts["bash"], option
            assert f"*{option}[" in texts["zsh"], option
            assert f"-l {option[2:]}" in texts["fish"], option


TRICKY = CompletedCommand(
    "new",
    "It's [a] 50 % 'test': of $HOME, \\ and `pwd`",
    (CompletedOption(("--to", "-t"), 'the body\'s "place" [m]: $x', True, ("a", "b")),),
    (),
)


@pytest.mark.parametrize(
    ("shell", "script", "check"),
    [("bash", bash_script, "-n"), ("zsh", zsh_script, "-n"), ("fish", fish_script, "--no-execute")],
)
def test_descriptions_are_quoted(shell, script, check, tmp_path):
    file = tmp_path / "script"
    file.write_text(script([TRICKY], ()))
    run_shell(need(shell), check, file)
    if shell in COMPLETERS:
        found = COMPLETERS[shell](file, "collocation-sysid new --to ")
        assert sorted(found) == ["a", "b"]


def test_an_unknown_shell_is_refused_with_the_known_ones():
    outcome = run_command("completion", "tcsh")
    assert outcome.code == 2
    assert "tcsh" in outcome.err
    assert "bash" in outcome.err
    assert "fish" in outcome.err
