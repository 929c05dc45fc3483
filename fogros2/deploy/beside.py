# SPDX-License-Identifier: Apache-2.0
"""Step 9: containers beside a machine's nodes."""

from __future__ import annotations

from fogros2 import containers
from fogros2.deploy.job import Job
from fogros2.errors import CommandError, PrerequisiteError
from fogros2.shell import Shell


def start(job: Job, shell: Shell) -> None:
    """
    Start a machine's containers, before its nodes; an engine is installed where there is none.

    :raises CommandError: an image can't be had, or a container doesn't start.
    :raises PrerequisiteError: the machine can't have an engine.
    """
    if not job.spec.containers:
        return
    launch = job.launch.id
    with job.step('containers') as detail:
        if not shell.run(containers.find(), timeout=job.timeouts.command,
                         cancel=job.cancel).stdout.strip():
            try:
                shell.run(containers.install(), timeout=job.timeouts.install, cancel=job.cancel)
            except CommandError as error:
                raise PrerequisiteError(
                    f"'{job.name}' has neither podman nor docker, and podman can't be installed: "
                    f'{error}', 'take an image with one of them') from error

        def removed() -> None:
            if job.survives:
                job.tidy(shell, [containers.remove(launch)])

        job.undoing('containers', removed)
        for number, line in enumerate(job.spec.containers):
            shell.run(containers.run(containers.parse(line), number, launch),
                      timeout=job.timeouts.install, cancel=job.cancel)
        detail.append(f'{len(job.spec.containers)}')
