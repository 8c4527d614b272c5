"""Check that a wheel holds the package and nothing else, and write the checksums of a release.

python .ci/contents.py dist    writes dist/SHA256SUMS: every file in the wheel, the wheel and the sdist
"""

from __future__ import annotations

import hashlib
import sys
import zipfile
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "src" / "pianofit"
# Files that describe the package, in the folder NAME-VERSION.dist-info.
DESCRIPTION = {"METADATA", "WHEEL", "RECORD", "entry_points.txt", "licenses/LICENSE"}


def differences(names: list[str]) -> list[str]:
    """Return what a wheel has too much or too little, one line for each file.

    Parameters
    ----------
    names : files in the wheel.
    """
    (info,) = {name.split("/")[0] for name in names if ".dist-info/" in name}
    package = {f"pianofit/{file.relative_to(PACKAGE).as_posix()}" for file in PACKAGE.rglob("*") if file.is_file()}
    expected = {name for name in package if "__pycache__" not in name} | {f"{info}/{name}" for name in DESCRIPTION}
    surplus = [f"{name} is not part of the package" for name in sorted({*names} - expected)]
    return surplus + [f"{name} is missing in the wheel" for name in sorted(expected - {*names})]


def checksums(dist: Path) -> str:
    """Return the lines of SHA256SUMS: the files in the wheel, then the archives, as `sha256sum` writes them."""
    (wheel,) = dist.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        content = {f"{wheel.name}/{name}": archive.read(name) for name in sorted(archive.namelist())}
    archives = {file.name: file.read_bytes() for file in sorted([wheel, *dist.glob("*.tar.gz")])}
    lines = [f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in {**content, **archives}.items()]
    return "".join(lines)


def main() -> None:
    """Check the wheel in a folder and write the checksums."""
    dist = Path(sys.argv[1])
    (wheel,) = dist.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        found = differences(archive.namelist())
    if found:
        raise SystemExit("\n".join(found))
    (dist / "SHA256SUMS").write_text(checksums(dist), encoding="utf-8")
    print(f"{wheel.name} holds the package and nothing else")


if __name__ == "__main__":
    main()
