# SPDX-License-Identifier: Apache-2.0
"""
Hide the files in this computer's folders that not everybody may read from a container machine.

Root on the machine owns root's files there, and so could read them. Programs that everybody may
run and empty files hold no secret.

The search looks at every file: half a second of a processor for 160,000 files. So it runs while
the engine prepares the container, and its result for a folder is valid until a folder in it
changes, or a file in ``/usr/local``. Elsewhere, a file whose mode alone changes was public before.

Runs as python3 -c SOURCE TOP, as root, where TOP is the folder of a machine. Reads ``shown``, the
folders that the machine shows, one a line. Writes ``hidden``, the paths found, each ended by a
zero byte. Imports nothing of fogros2.
"""

from __future__ import annotations

from collections.abc import Mapping
import contextlib
import json
import os
from pathlib import Path
import stat
import sys
import time

#: The last result, in a folder of root's.
CACHE = Path('/var/cache/fogros2/hidden.json')
#: Where administrators put files of their own.
LOCAL = '/usr/local'
#: Nanoseconds in which a second change of a path may leave its time as it is.
TICK = 20_000_000

#: Shell text that puts something empty over each path, in the machine with the folder ``$1``; a
#: hook in the machine's namespaces, whose root is still this computer's. The machine has no right
#: to take it away.
HIDE = """\
PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
[ -e "$1/shown" ] || exit 0
tries=0
until [ -e "$1/hidden" ]; do
    [ $((tries += 1)) -lt 3000 ] || { echo 'the search for hidden files did not end' >&2; exit 1; }
    sleep 0.02
done
[ -s "$1/hidden" ] || exit 0
mkdir -p "$1/empty"
chmod 0 "$1/empty"
xargs -0 -n 1 sh -c '
    empty=$0/empty
    [ -d "$0/root$1" ] || empty=/dev/null
    [ ! -e "$0/root$1" ] || mount --bind "$empty" "$0/root$1"' "$1" <"$1/hidden"
"""


def source() -> str:
    """Return the text of this program."""
    return Path(__file__).read_text()


def search(top: str, local: str = LOCAL) -> tuple[list[str], dict[str, int]]:
    """
    Return the paths to hide below a folder, and when the paths they depend on changed (ns).

    :param local: the files below this folder are among the latter.
    """
    found: list[str] = []
    changed: dict[str, int] = {}
    todo, device = [top], os.stat(top).st_dev
    while todo:
        folder = todo.pop()
        with contextlib.suppress(FileNotFoundError):  # removed meanwhile
            status = os.stat(folder)
            if status.st_dev != device:
                continue  # another file system, which the machine does not show
            changed[folder] = status.st_ctime_ns
            is_folder = stat.S_ISDIR(status.st_mode)
            if not status.st_mode & (0o001 if is_folder else 0o005):
                found.append(folder)
                continue
            for entry in os.scandir(folder) if is_folder else ():
                if entry.is_dir(follow_symlinks=False):
                    todo.append(entry.path)
                elif entry.is_file(follow_symlinks=False):
                    with contextlib.suppress(FileNotFoundError):
                        status = entry.stat(follow_symlinks=False)
                        if not status.st_mode & 0o005 and status.st_size:
                            found.append(entry.path)
                        if folder.startswith(local):
                            changed[entry.path] = status.st_ctime_ns
    return found, changed


def unchanged(changed: Mapping[str, int]) -> bool:
    """Return whether no path has changed since."""
    try:
        return all(os.stat(path).st_ctime_ns == at for path, at in changed.items())
    except OSError:
        return False


def main(top: Path, cache: Path = CACHE) -> None:
    """Write a machine's hidden files, by the last results for its folders where they are valid."""
    begin = time.time_ns()
    try:
        results = json.loads(cache.read_text())
    except (OSError, ValueError):
        results = {}
    folders = (top / 'shown').read_text().splitlines()
    fresh = {folder: search(folder) for folder in folders
             if folder not in results or not unchanged(results[folder][1])}
    results.update(fresh)
    aside = top / 'hidden.new'
    aside.write_bytes(b''.join(
        os.fsencode(path) + b'\0' for folder in folders for path in results[folder][0]))
    aside.replace(top / 'hidden')
    if fresh:
        # a change that was a moment ago may hide another one
        kept = {folder: results[folder] for folder in folders
                if max(results[folder][1].values()) < begin - TICK}
        cache.parent.mkdir(mode=0o700, exist_ok=True)
        new = cache.with_name(f'{top.name}.new')
        new.write_text(json.dumps(kept))
        new.replace(cache)


if __name__ == '__main__':
    main(Path(sys.argv[1]))
