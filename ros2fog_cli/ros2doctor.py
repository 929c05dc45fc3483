# SPDX-License-Identifier: Apache-2.0
"""
Show the checks of ``ros2 fog doctor`` in ``ros2 doctor``.

Only ros2doctor of ROS 2 loads this module (``ros2doctor.checks``, ``ros2doctor.report``).
"""

from __future__ import annotations

import functools

from ros2doctor.api import DoctorCheck, DoctorReport, Report, Result
from ros2doctor.api.format import doctor_error, doctor_warn

from ros2fog_cli.api import doctor

#: Links the check to its report, which ``ros2 doctor`` prints for a failed check.
CATEGORY = 'fogros2'


@functools.lru_cache(maxsize=1)
def findings() -> tuple[doctor.Check, ...]:
    """Run the checks once; ``ros2 doctor --report-failed`` needs them for both classes below."""
    # ros2doctor has its own check of the LAN.
    return tuple(doctor.examine(lan_seconds=0))


def _text(check: doctor.Check) -> str:
    return f'{check.detail} ({check.remedy})' if check.remedy and check.verdict != 'ok' \
        else check.detail


class FogCheck(DoctorCheck):
    """Check whether this computer has what a launch with cloud machines needs."""

    def category(self) -> str:
        """Return the category, which links the check to its report."""
        return CATEGORY

    def check(self) -> Result:
        """Report failures and warnings, each with its remedy."""
        result = Result()
        for check in findings():
            if check.verdict == 'failed':
                doctor_error(f'FogROS2, {check.name}: {_text(check)}')
                result.add_error()
            elif check.verdict == 'warning':
                doctor_warn(f'FogROS2, {check.name}: {_text(check)}')
                result.add_warning()
        return result


class FogReport(DoctorReport):
    """Report the results of all checks of this computer."""

    def category(self) -> str:
        """Return the category, which links the report to its check."""
        return CATEGORY

    def report(self) -> Report:
        """Return the result of each check."""
        report = Report('FOGROS2')
        for check in findings():
            report.add_to_report(
                check.name, f'{check.verdict}: {_text(check)}')
        return report
