"""Tables as spreadsheets write them: commas, semicolons or tabs between cells; with the latter two, decimal commas."""

import codecs
import csv
import io
import re
from collections.abc import Iterator
from pathlib import Path

from diffproj.cli.inputs import LARGEST_NUMBER

DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+")


class Spreadsheet:
    """The lines of a CSV file that say something: empty ones and those that begin with `#` are passed over.

    Attributes:
        separator: what stands between cells.
        path: the file.
    """

    def __init__(self, option: str, path: Path, want: str) -> None:
        """Read a file.

        Args:
            option: of the command line, for messages.
            path: the file.
            want: what its lines should be, for messages.

        Raises:
            ValueError: it is no text in UTF-8, nor in UTF-16 with the mark in front that says so.
            OSError: it cannot be read.
        """
        content = path.read_bytes()
        # As Excel writes its "Unicode text".
        wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        try:
            text = content.decode("utf-16" if wide else "utf-8-sig")
        except UnicodeDecodeError:
            raise ValueError(
                f"{option}: want a text file in UTF-8, got something else in {path}; spreadsheets write one as 'CSV "
                "UTF-8'"
            ) from None
        self._text = text.replace("\r\n", "\n").replace("\r", "\n")
        self._option, self._want, self.path = option, want, path
        told = (line for line in self._text.splitlines() if line.strip() and not line.lstrip().startswith("#"))
        first = next(told, "")
        self.separator = next((mark for mark in ";\t" if mark in first), ",")
        cells = [] if self.separator == "," else re.split(f"[{self.separator}\n]", self._text)
        self._decimal_commas = any(DECIMAL_COMMA.fullmatch(cell.strip()) for cell in cells)

    def lines(self) -> Iterator[tuple[int, list[str]]]:
        """The number of each line, from 1, and its cells without spaces around them.

        Raises:
            ValueError: a line cannot be read as cells.
        """
        reader = csv.reader(io.StringIO(self._text), delimiter=self.separator, skipinitialspace=True)
        try:
            for row in reader:
                cells = [cell.strip() for cell in row]
                if any(cells) and not cells[0].startswith("#"):
                    yield reader.line_num, cells
        except csv.Error as error:
            raise ValueError(
                f"{self._option}: want {self._want}, got something else in {self.path} ({error})"
            ) from None

    def number(self, cell: str) -> float | None:
        """The number in a cell; `None` where there is none, or one that is not finite or beyond 1e100.

        Raises:
            ValueError: it has a point in a file of decimal commas: for thousands, or for decimals?
        """
        try:
            value = float(cell if self.separator == "," else cell.replace(",", "."))
        except ValueError:
            return None
        if self._decimal_commas and "." in cell:
            raise ValueError(
                f"{self._option}: want decimal commas in all numbers and no mark between thousands, got {cell!r} "
                f"beside decimal commas in {self.path}"
            )
        return value if abs(value) <= LARGEST_NUMBER else None

    def joined(self, cells: list[str]) -> str:
        """The cells as they stand in the file."""
        return self.separator.join(cells)
