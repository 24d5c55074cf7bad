"""Labels of video clips: what each shows, and when contact occurs.

`labels.csv` has the columns `clip` (a file beside it), `kind`, `contact_s` (empty without contact) and any others:

```text
clip,kind,contact_s,what
c01.mp4,collision,2.1,night; another car crosses and is hit
nc03.mp4,none,,an oncoming car passes
```

Kinds `collision` and `approach` call for an alarm, with or without a time of contact. All others do not.
"""

import csv
import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from lgmdjax.errors import InputError

APPROACHING = ("collision", "approach")  # kinds that call for an alarm
OTHERS = ("none", "recede", "translate")  # common kinds that do not
COLUMNS = ("clip", "kind", "contact_s")


@dataclass(frozen=True, kw_only=True)
class Label:
    """What a clip shows."""

    clip: str  # name of the file
    kind: str
    contact: float | None = None  # s
    what: str = ""  # description

    @property
    def is_approach(self) -> bool:
        """Whether there should be an alarm."""
        return self.kind in APPROACHING


def read_labels(path: Path) -> list[Label]:
    """Return the labels of a CSV file.

    Raises `InputError` for a file that is missing, that has no rows, or whose rows contradict themselves.
    """
    expected = f"expected labels with the columns {', '.join(COLUMNS)} in {path}"
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, restkey="rest")
            missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                raise InputError(f"{expected}, got none called {', '.join(missing)}; add them to the first line")
            labels = [_read_row(row, f"{path}, line {reader.line_num}") for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{expected}, got no such file ({error}); write one, or name another") from error
    repeated = sorted(clip for clip, rows in Counter(label.clip for label in labels).items() if rows > 1)
    if repeated or not labels:
        found = f"{repeated[0]} {'and others ' * (len(repeated) > 1)}twice" if repeated else "no row"
        raise InputError(f"{expected}, a row for each clip, got {found}; correct the rows")
    return labels


def _read_row(row: dict[str, str], where: str) -> Label:
    clip, kind, contact = ((row[name] or "").strip() for name in COLUMNS)
    if not clip or not kind:
        raise InputError(f"{where}: expected a clip and its kind, got {clip!r} and {kind!r}; fill both in")
    if Path(clip).is_absolute() or ".." in Path(clip).parts or "\0" in clip:
        raise InputError(f"{where}: expected a clip in the folder of the videos, got {clip!r}; move it there")
    try:
        time = float(contact) if contact else None
    except ValueError:
        time = math.nan
    if time is not None and not 0 <= time < math.inf:
        raise InputError(f"{where}: expected seconds or nothing as contact_s, got {contact!r}; correct it")
    if time is not None and kind not in APPROACHING:
        raise InputError(
            f"{where}: expected no contact_s for kind {kind!r}, got {contact}; "
            f"use kind {' or '.join(APPROACHING)}, or leave it empty"
        )
    return Label(clip=clip, kind=kind, contact=time, what=(row.get("what") or "").strip())
