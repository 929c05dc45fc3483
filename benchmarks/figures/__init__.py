# SPDX-License-Identifier: Apache-2.0
"""
What all benchmarks share: rows of figures, and how they are written down.

Each benchmark writes ``results/<name>.json``, a Markdown table and, where ``plots.PANELS`` has the
name, a picture. ``python -m figures`` writes tables and pictures again from the stored figures.
Absolute times hold for the computer they were taken on; targets are held against differences and
ratios within one run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import dataclasses
import datetime
from importlib import metadata
import json
import os
from pathlib import Path
import platform
import statistics
import time
from typing import Literal, Optional

from figures import plots
from figures.plots import number

RESULTS = Path(__file__).parents[1] / 'results'


@dataclasses.dataclass(frozen=True)
class Row:
    """
    One figure.

    :param target: what it should be at the most (or least), in ``unit``; None for a figure that
        others are compared with.
    :param published: what FogROS2's authors published for it, as text.
    :param runs: how many runs ``value`` is the median of.
    :param low: ``low`` to ``high``, in ``unit``, has 90 % of the runs; None if that is unknown.
    """

    what: str
    value: float
    unit: str
    target: Optional[float] = None
    better: Literal['less', 'more'] = 'less'
    published: str = ''
    runs: int = 1
    low: Optional[float] = None
    high: Optional[float] = None

    @classmethod
    def of(
        cls, what: str, values: Sequence[float], unit: str, target: Optional[float] = None,
        better: Literal['less', 'more'] = 'less', published: str = '',
    ) -> Row:
        """Return the median of runs with their spread: of fewer than 20 runs, all."""
        ordered = sorted(values)
        cut = len(ordered) // 20
        return cls(what, statistics.median(ordered), unit, target, better, published,
                   len(ordered), ordered[cut], ordered[-1 - cut])

    @property
    def reached(self) -> Optional[bool]:
        """Whether the target is reached, None without one."""
        if self.target is None:
            return None
        return self.value <= self.target if self.better == 'less' else self.value >= self.target


def seconds(action: Callable[[], object]) -> float:
    """Return how long a call takes, in seconds."""
    begin = time.perf_counter()
    action()
    return time.perf_counter() - begin


def machine() -> str:
    """Return a line about this computer."""
    model = platform.machine()
    for line in Path('/proc/cpuinfo').read_text().splitlines():
        if line.startswith('model name'):
            model = line.partition(':')[2].strip()
            break
    memory = os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30
    return (f'{model}, {os.cpu_count()} cores, {memory:.0f} GiB, Linux {platform.release()}, '
            f'Python {platform.python_version()}, {ros()}')


def today() -> str:
    """Return the date as results have it."""
    return datetime.date.today().isoformat()


def origin(rows: Iterable[tuple[str, str, str]]) -> tuple[str, str]:
    """
    Return where rows were measured, and the newest date; several places name their rows.

    :param rows: name, computer and date of each row.
    """
    places: dict[tuple[str, str], list[str]] = {}
    for name, computer, date in rows:
        names = places.setdefault((computer, date), [])
        if name not in names:
            names.append(name)
    newest = max(date for _, date in places)
    if len(places) == 1:
        return next(iter(places))
    return '; '.join(f"{', '.join(map(repr, names))}: {computer}, {date}"
                     for (computer, date), names in places.items()), newest


def ros() -> str:
    """Return the versions of rclpy and of the middleware that nodes use here."""
    rmw = os.environ.get('RMW_IMPLEMENTATION') or 'rmw_fastrtps_cpp'
    try:
        return (f"rclpy {metadata.version('ros-rclpy')} from wheels with {rmw} "
                f"{metadata.version('ros-rmw-fastrtps-cpp')} (Fast DDS "
                f"{metadata.version('ros-fastrtps')})")
    except metadata.PackageNotFoundError:
        return f"ROS 2 {os.environ.get('ROS_DISTRO', 'of this computer')} with {rmw}"


def write(
    name: str, title: str, rows: Sequence[Row], results: Path = RESULTS, computer: str = '',
    date: str = '',
) -> None:
    """
    Write the figures as JSON, as a table and as a picture, and print the table.

    :param computer: that the rows were measured on, '' for this one.
    :param date: of the measurement, '' for today.
    """
    results.mkdir(parents=True, exist_ok=True)
    date = date or today()
    computer = computer or machine()
    data = {'machine': computer, 'date': date, 'rows': [dataclasses.asdict(r) for r in rows]}
    (results / f'{name}.json').write_text(json.dumps(data, indent=1) + '\n')
    print(show(name, title, results))


def names(results: Path = RESULTS) -> list[str]:
    """Return the names of all benchmarks that have stored figures."""
    stored = {path.stem: json.loads(path.read_text()) for path in sorted(results.glob('*.json'))}
    return [name for name, data in stored.items() if isinstance(data, dict) and 'machine' in data]


def heading(name: str, results: Path = RESULTS) -> str:
    """Return the title of stored figures, which their table has."""
    return (results / f'{name}.md').read_text().partition('\n')[0].removeprefix('# ')


def table(name: str, title: str, results: Path = RESULTS) -> str:
    """Return the table of stored figures, with their picture if they have one."""
    note, rows = stored(name, results)
    return markdown(title, rows, note, f'{name}.png' if name in plots.PANELS else '')


def stored(name: str, results: Path = RESULTS) -> tuple[str, list[Row]]:
    """Return where and when stored figures were measured, and the figures."""
    data = json.loads((results / f'{name}.json').read_text())
    return f"{data['machine']}; {data['date']}", [Row(**row) for row in data['rows']]


def show(name: str, title: str, results: Path = RESULTS) -> str:
    """Write the table and the picture of stored figures, and return the table."""
    text = table(name, title, results)
    (results / f'{name}.md').write_text(text)
    if name in plots.PANELS:
        plots.draw(results / f'{name}.png', title, *stored(name, results))
    return text


def markdown(title: str, rows: Sequence[Row], note: str, picture: str = '') -> str:
    """Return the table as Markdown, the picture below it."""
    words = {True: 'yes', False: '**no**', None: ''}
    lines = [f'# {title}', '', note, '',
             '| What | Value | Target | Reached | Runs | Published for FogROS2 |',
             '|---|---|---|---|---|---|']
    for row in rows:
        sign = '≤' if row.better == 'less' else '≥'
        target = '' if row.target is None else f'{sign} {number(row.target)} {row.unit}'
        spread = ('' if row.low is None or row.high is None else
                  f' ({number(row.low)} to {number(row.high)})')
        lines.append(f'| {row.what} | {number(row.value)} {row.unit}{spread} | {target} | '
                     f'{words[row.reached]} | {row.runs} | {row.published} |')
    if picture:
        lines += ['', f'![{title}]({picture})']
    return '\n'.join([*lines, ''])
