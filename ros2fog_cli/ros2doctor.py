# SPDX-License-Identifier: Apache-2.0
"""
What ``ros2 doctor`` says of FogROS2: the checks of ``ros2 fog doctor``.

For ros2doctor alone (``ros2doctor.checks``, ``ros2doctor.report``), which is where ROS 2 is.
"""

from __future__ import annotations

import functools

from ros2doctor.api import DoctorCheck, DoctorReport, Report, Result
from ros2doctor.api.format import doctor_error, doctor_warn

from ros2fog_cli.api import doctor

#: Links the check with its report: what ``ros2 doctor`` prints of a check that failed.
CATEGORY = 'fogros2'


@functools.lru_cache(maxsize=1)
def findings() -> tuple[doctor.Check, ...]:
    """Return the checks, made once: ``ros2 doctor --report-failed`` asks for both below."""
    # the LAN is ros2doctor's own to look at
    return tuple(doctor.examine(lan_seconds=0))


def _text(check: doctor.Check) -> str:
    return f'{check.detail} ({check.remedy})' if check.remedy and check.verdict != 'ok' \
        else check.detail


class FogCheck(DoctorCheck):  # type: ignore[misc]
    """Look whether this computer has what a launch with cloud machines needs."""

    def category(self) -> str:
        """Return what links it with its report."""
        return CATEGORY

    def check(self) -> Result:
        """Say what isn't right, each thing with its remedy."""
        result = Result()
        for found in findings():
            if found.verdict == 'failed':
                doctor_error(f'FogROS2, {found.name}: {_text(found)}')
                result.add_error()
            elif found.verdict == 'warning':
                doctor_warn(f'FogROS2, {found.name}: {_text(found)}')
                result.add_warning()
        return result


class FogReport(DoctorReport):  # type: ignore[misc]
    """Tell what a launch with cloud machines would find here."""

    def category(self) -> str:
        """Return what links it with its check."""
        return CATEGORY

    def report(self) -> Report:
        """Return each thing that was looked at."""
        report = Report('FOGROS2')
        for found in findings():
            report.add_to_report(
                found.name, f'{found.verdict}: {_text(found)}')
        return report
