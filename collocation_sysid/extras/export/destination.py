"""Destinations of exports, as the option --to names them: a format, a file or a folder."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from ...common.files import replaced_file, require_possible
from ...common.written_files import (
    LIST_FILE,
    hashes_of,
    is_written_here,
    list_as_text,
    listed_hashes,
)
from ...errors import InputError, hint_at
from ...result.run_writers import require_no_link


@dataclass(frozen=True)
class ExportDestination:
    """Format and place of an export."""

    format_name: str  # name of the format, such as "mujoco"
    folder: Path  # folder of the files
    main_file: Path  # file that the simulator or viewer opens
    # Whether the export is the whole folder, which is replaced completely. Otherwise its files are
    # put into the folder beside other files, and their names begin with that of `main_file`.
    is_folder: bool

    def require_possible(self) -> None:
        """Refuse a destination that cannot be written, before any work is done for it.

        Raises
        ------
        InputError
            If the folder cannot be made, or the file is a folder, a link, or a file that this
            program did not write.
        """
        require_possible(self.folder)
        if not self.is_folder:
            require_no_link(self.folder)
            _require_replaceable(self.main_file)

    @contextmanager
    def export_folder(self) -> Iterator[Path]:
        """Context with the folder to export into: the destination itself, or, if that is a file, a
        path in a temporary folder, which does not exist yet and is removed at the end of the
        context.
        """
        if self.is_folder:
            yield self.folder
            return
        with tempfile.TemporaryDirectory() as scratch:
            yield Path(scratch) / "export"

    def place_files(self, exported: Path, main_name: str) -> None:
        """Copy the files of an export to a destination that is a file, all of them or none.

        The file `main_name` becomes `main_file`, and a file that differs from it in the suffix only
        keeps its own suffix; the names of all others are put after that of `main_file` and "_".
        Files with these names are replaced only if this program wrote them and nobody changed them.
        The list of written files in the folder gets their names. Does nothing if the destination is
        a folder.

        Parameters
        ----------
        exported : Path
            Folder of `export_folder`, after the export.
        main_name : str
            Name of the main file in that folder.

        Raises
        ------
        InputError
            Naming the file that cannot be replaced or written.
        """
        if self.is_folder:
            return
        stem = self.main_file.stem
        contents = {}
        for each in sorted(exported.iterdir()):
            if each.name == main_name:
                contents[self.main_file] = each
            elif each.stem == Path(main_name).stem:
                contents[self.folder / f"{stem}{each.suffix}"] = each
            elif each.name != LIST_FILE:
                contents[self.folder / f"{stem}_{each.name}"] = each
        for file in contents:
            _require_replaceable(file)
        hashes = hashes_of({file.name: each for file, each in contents.items()})
        with ExitStack() as stack:  # all files appear at its end, or none
            for file, each in contents.items():
                draft = stack.enter_context(replaced_file(file))
                draft.write_bytes(each.read_bytes())
            listing = stack.enter_context(replaced_file(self.folder / LIST_FILE))
            text = list_as_text(listed_hashes(self.folder) | hashes)
            listing.write_text(text, encoding="utf-8")


def parse_destination(
    text: str, main_files: Mapping[str, str], run_folder: Path, out: Path | None = None
) -> ExportDestination:
    """Return the destination that --to names.

    Parameters
    ----------
    text : str
        Name of a format; a file, whose suffix is that of a format; or a folder, whose name is that
        of a format or ends with "-" and that name.
    main_files : mapping of str to str
        Name of the main file of each format.
    run_folder : Path
        Run folder, which contains the default destination of a format, export-FORMAT.
    out : Path, optional
        Folder to use instead of the default destination of a format.

    Raises
    ------
    InputError
        For a text from which no format follows, or several, and for `out` together with a file or
        folder.
    """
    if text in main_files:
        folder = out or run_folder / f"export-{text}"
        return ExportDestination(text, folder, main_file=folder / main_files[text], is_folder=True)
    path = Path(text)
    suffix = path.suffix.lower()
    if suffix:
        formats = [name for name, file in main_files.items() if Path(file).suffix == suffix]
    else:
        formats = [name for name in main_files if f"-{path.name}".endswith(f"-{name}")]
    if not formats:
        raise InputError(
            f"found {text!r}; expected the name of a format, or a file with its suffix: "
            + ", ".join(f"{name} ({Path(file).suffix})" for name, file in main_files.items())
            + hint_at(text, main_files),
            None,
            where="--to",
        )
    if len(formats) > 1:
        raise InputError(
            f"found {text!r}, but {suffix} is the suffix of {' and '.join(formats)}; write the "
            f"name of the format, such as --to {formats[0]}, and a folder with --out",
            None,
            where="--to",
        )
    if out is not None:
        raise InputError(
            f"--to names the destination {text} already; leave out --out, or write --to "
            f"{formats[0]}",
            None,
            where="--out",
        )
    (name,) = formats
    if suffix:
        return ExportDestination(name, path.parent, main_file=path, is_folder=False)
    return ExportDestination(name, path, main_file=path / main_files[name], is_folder=True)


def _require_replaceable(file: Path) -> None:
    """A file of others, a changed one, a folder or a link is refused."""
    if file.is_dir() and not file.is_symlink():
        raise InputError("this is a folder; expected a file to write", file, where="--to")
    if (file.exists() or file.is_symlink()) and not is_written_here(file):
        raise InputError(
            "this file exists and was not written by this program, or was changed since, so it "
            "is not overwritten; choose another name, or move the file",
            file,
        )
