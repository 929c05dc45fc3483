# SPDX-License-Identifier: Apache-2.0
"""
What all benchmarks share: rows of figures, and how they are written down.

Each benchmark writes ``results/<name>.json``, a Markdown table and a plot. Absolute times hold for
the computer they were taken on; targets are held against differences and ratios within one run.
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

RESULTS = Path(__file__).parents[1] / 'results'


@dataclasses.dataclass(frozen=True)
class Row:
    """
    One figure.

    :param target: what it should be at the most (or least), in ``unit``; None for a figure that
        others are compared with.
    :param published: what FogROS2's authors published for it, as text.
    :param runs: how many runs ``value`` is the median of.
    """

    what: str
    value: float
    unit: str
    target: Optional[float] = None
    better: Literal['less', 'more'] = 'less'
    published: str = ''
    runs: int = 1

    @property
    def reached(self) -> Optional[bool]:
        """Whether the target is reached, None without one."""
        if self.target is None:
            return None
        return self.value <= self.target if self.better == 'less' else self.value >= self.target


def median_of(runs: int, measure: Callable[[], float]) -> float:
    """Return the median of ``runs`` calls."""
    return statistics.median(measure() for _ in range(runs))


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
    Write the figures as JSON, Markdown and a plot, and print the table.

    :param computer: that the rows were measured on, '' for this one.
    :param date: of the measurement, '' for today.
    """
    results.mkdir(parents=True, exist_ok=True)
    date = date or today()
    computer = computer or machine()
    data = {'machine': computer, 'date': date, 'rows': [dataclasses.asdict(r) for r in rows]}
    (results / f'{name}.json').write_text(json.dumps(data, indent=1) + '\n')
    text = markdown(title, rows, f'{computer}; {date}')
    (results / f'{name}.md').write_text(text)
    print(text)
    plot(results / f'{name}.png', title, rows)


def markdown(title: str, rows: Sequence[Row], note: str) -> str:
    """Return the table as Markdown."""
    words = {True: 'yes', False: '**no**', None: ''}
    lines = [f'# {title}', '', note, '',
             '| What | Value | Target | Reached | Runs | Published for FogROS2 |',
             '|---|---|---|---|---|---|']
    for row in rows:
        sign = '≤' if row.better == 'less' else '≥'
        target = '' if row.target is None else f'{sign} {row.target:g} {row.unit}'
        lines.append(f'| {row.what} | {row.value:.4g} {row.unit} | {target} | '
                     f'{words[row.reached]} | {row.runs} | {row.published} |')
    return '\n'.join([*lines, ''])


def plot(path: Path, title: str, rows: Sequence[Row]) -> None:
    """Draw each figure as a bar, one panel per unit, its target as a line across."""
    import matplotlib
    matplotlib.use('Agg')
    from matplotlib import pyplot

    units = list(dict.fromkeys(row.unit for row in rows))
    heights = [sum(row.unit == unit for row in rows) for unit in units]
    figure, axes = pyplot.subplots(
        len(units), figsize=(9, 0.7 + 0.55 * len(rows) + 0.7 * len(units)), squeeze=False,
        height_ratios=heights, layout='constrained')
    figure.suptitle(title)
    for unit, axis in zip(units, axes[:, 0]):
        shown = [row for row in rows if row.unit == unit]
        for at, row in enumerate(shown):
            colour = {True: '#2a7f62', False: '#b3412e', None: '#7a8794'}[row.reached]
            axis.barh(at, row.value, color=colour, height=0.6)
            axis.text(row.value, at, f' {row.value:.3g}', va='center')
            if row.target is not None:
                axis.plot([row.target] * 2, [at - 0.4, at + 0.4], color='black', linewidth=2)
        axis.set_yticks(range(len(shown)), [row.what for row in shown])
        axis.invert_yaxis()
        axis.margins(x=0.15)
        axis.set_xlabel(f'{unit} (black: target)')
        axis.spines[['top', 'right']].set_visible(False)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
