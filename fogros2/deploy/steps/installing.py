# SPDX-License-Identifier: Apache-2.0
"""Install ROS 2, the workspaces, and the Python modules that programs import."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import functools
from pathlib import Path
import platform
import sys
import threading
from typing import Optional

from fogros2 import plan
from fogros2.deploy.context import Context
from fogros2.deploy.machine_job import MachineJob, Step
from fogros2.errors import CommandError, PrerequisiteError
from fogros2.host import bootstrap, installer, modules, workspace
from fogros2.model import Command, NodeSpec
from fogros2.report import Progress, Warned
from fogros2.shell import retried


def install_ros(
    context: Context, job: MachineJob, armed: Callable[[], object],
    on_plan: Callable[[bootstrap.RosInstall], object],
) -> bootstrap.RosInstall:
    """
    Install what ROS 2 nodes need on the machine; see :func:`~.bootstrap.ensure`.

    :param armed: waits until the watchdog is armed.
    """
    with job.step('ROS 2') as detail:
        ros, note = bootstrap.ensure(
            job.shell, context.underlay(job.spec.workspaces), job.spec,
            timeout=context.timeouts.install, cancel=job.cancel, ready=armed, on_plan=on_plan,
            elsewhere=True, packages=context.packages, at_home=context.capabilities.account,
            owned=context.capabilities.owned,
            warn=lambda text, hint: context.report(Warned(job.name, text, hint)))
        detail.append(note)
        return ros


def send_workspaces(
    context: Context, job: MachineJob, ros: bootstrap.RosInstall,
    installed: Callable[[], object],
) -> None:
    """
    Send the workspaces; build them on the machine if needed.

    :param installed: waits until ROS 2 is installed, which a build needs.
    """
    if job.spec.workspace is None:
        return
    with job.step('workspace') as detail:
        note = workspace.transfer(
            job.shell, ros.workspaces, timeouts=context.timeouts,
            owned=context.capabilities.owned, cancel=job.cancel, before_build=installed,
            on_progress=lambda done, total: context.report(
                Progress(job.name, 'workspace', done, total)))
        detail += [note, *workspace.left_behind(context.environment, job.spec.workspaces)]


class Modules(Step):
    """
    The Python modules that programs on one machine import; thread-safe.

    :param ros: how nodes run there.
    """

    def __init__(self, context: Context, job: MachineJob, ros: bootstrap.RosInstall) -> None:
        super().__init__(context, job)
        self._environment = plan.extended(ros.environment, job.spec.environment)
        self._setup = ros.setup
        self._home = ros.facts.home
        self._lock = threading.Lock()
        #: Folder of each module, '' for those that the machine has itself.
        self._folders: dict[str, str] = {}

    def fitted(self, nodes: Sequence[NodeSpec]) -> list[NodeSpec]:
        """
        Install the modules that nodes import; return the nodes with the path to them.

        :raises PrerequisiteError: a module cannot be installed.
        """
        self.ensure((node.package, node.executable) for node in nodes)
        return [modules.fitted(node, self._folders) for node in nodes]

    def ensure(self, programs: Iterable[tuple[str, str]]) -> None:
        """
        Install the modules that (package, executable) pairs import and the machine lacks.

        :raises PrerequisiteError: a module cannot be installed.
        """
        with self._lock:
            names = [name for name in modules.needed_by(programs) if name not in self._folders]
            if names:
                with self._job.step('Python modules') as detail:
                    detail.append(self._install(names))

    def _install(self, names: Sequence[str]) -> str:
        present = self._ask(names)
        target, how = '', 'there already'
        if present.missing:
            copy = modules.copy(present)
            target = modules.folder(
                self._home, present, copy.versions if copy else modules.pinned(present.missing))
            how = 'there from before'
            if not self._has(target):
                self._fill(target, present, copy)
                how = f"{', '.join(present.missing)} {'installed' if copy is None else 'sent'}"
        self._folders |= {name: target if name in present.missing else '' for name in names}
        return how

    def _fill(
        self, target: str, present: modules.Answer, copy: Optional[modules.Copy],
    ) -> None:
        """Install the missing modules into a folder of the machine."""
        if copy is not None:
            for folder, entries in copy.entries.items():
                # A sync does not delete excluded files, so the folders add up.
                retried(functools.partial(
                    self._job.shell.sync, Path(folder), f'{target}/site', excludes=('/*',),
                    includes=[f'/{entry}' for entry in entries],
                    timeout=self._context.timeouts.install, cancel=self._job.cancel))
        else:
            try:
                self._run(installer.pinned_install(
                    modules.pinned(present.missing), target, self._environment, self._setup))
            except CommandError as error:
                raise self._without(present, str(error)) from error
        after = self._ask(present.missing, f'{target}/site')
        if after.missing:
            self._run(Command(('rm', '-rf', target), what='delete modules that fail'))
            raise self._without(after, ': '.join(
                ['they were installed, and cannot be imported', *after.broken]))
        self._run(Command(('touch', f'{target}/complete'), what='note what is there'))

    def _has(self, target: str) -> bool:
        done = self._job.shell.run(
            Command(('test', '-e', f'{target}/complete'), what='look for installed modules'),
            timeout=self._context.timeouts.command, check=False, cancel=self._job.cancel)
        return done.returncode == 0

    def _ask(self, names: Sequence[str], site: str = '') -> modules.Answer:
        return modules.answer(self._run(
            modules.ask(names, self._environment, self._setup, site)))

    def _run(self, command: Command) -> str:
        return self._job.run(command, timeout=self._context.timeouts.install)

    def _without(self, present: modules.Answer, why: str) -> PrerequisiteError:
        names = ' '.join(modules.known()[name].distributions[0] for name in present.missing)
        if present.architecture != platform.machine():
            hint = (f"take an image with them (pip install {names}): this robot's own are for "
                    f'{platform.machine()} processors, and the machine has {present.architecture}')
        elif present.python != sys.version_info[:2]:
            version = '.'.join(map(str, present.python))
            hint = (f'take an image with them (pip install {names}), or a robot with Python '
                    f'{version} as there, whose modules can be sent')
        else:
            hint = (f'install them on the robot with pip, so that they can be sent, or use a '
                    f'machine that has them: pip install {names}')
        return PrerequisiteError(
            f"'{self._job.name}' can't get {', '.join(present.missing)}, which programs there "
            f'import: {why}', installer.library_hint(why) or hint)
