# SPDX-License-Identifier: Apache-2.0
"""Brings Python modules that programs need to a machine without them, when they are needed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
import platform
import re
import sys
import threading
from typing import Optional

from fogros2 import bootstrap, modules, plan
from fogros2.deploy.job import Job
from fogros2.errors import CommandError, PrerequisiteError
from fogros2.model import Command, NodeSpec
from fogros2.shell import Shell

#: Debian's packages of libraries that OpenCV's and PyAV's wheels expect of the system.
_PACKAGES = {'libGL.so.1': 'libgl1', 'libglib-2.0.so.0': 'libglib2.0-0',
             'libgthread-2.0.so.0': 'libglib2.0-0', 'libxcb.so.1': 'libxcb1'}


class Equipment:
    """
    What one machine has of the modules; thread-safe.

    :param ros: how nodes run there.
    """

    def __init__(self, job: Job, shell: Shell, ros: bootstrap.RosInstall) -> None:
        self._job = job
        self._shell = shell
        self._environment = plan.extended(ros.environment, job.spec.environment)
        self._setup = ros.setup
        self._home = ros.facts.home
        self._lock = threading.Lock()
        #: Where modules lie, '' for those that the machine has itself.
        self._places: dict[str, str] = {}

    def fitted(self, nodes: Sequence[NodeSpec]) -> list[NodeSpec]:
        """
        Return nodes that find what they import, brought now if none before them needed it.

        :raises PrerequisiteError: the machine can't have it.
        """
        self.ensure((node.package, node.executable) for node in nodes)
        return [modules.fitted(node, self._places) for node in nodes]

    def ensure(self, programs: Iterable[tuple[str, str]]) -> None:
        """
        Bring what (package, executable) pairs need and the machine lacks.

        :raises PrerequisiteError: the machine can't have it.
        """
        with self._lock:
            names = [name for name in modules.needed_by(programs) if name not in self._places]
            if names:
                with self._job.step('Python modules') as detail:
                    detail.append(self._bring(names))

    def _bring(self, names: Sequence[str]) -> str:
        there = self._ask(names)
        target, how = '', 'there already'
        if there.missing:
            copy = modules.copy(there)
            target = modules.folder(
                self._home, there, copy.versions if copy else modules.pinned(there.missing))
            how = 'there from before'
            if not self._has(target):
                self._fill(target, there, copy)
                how = f"{', '.join(there.missing)} {'installed' if copy is None else 'sent'}"
        self._places |= {name: target if name in there.missing else '' for name in names}
        return how

    def _fill(
        self, target: str, there: modules.Answer, copy: Optional[modules.Copy],
    ) -> None:
        """Put what is missing into a folder there."""
        if copy is not None:
            for folder, entries in copy.entries.items():
                # what is excluded is not deleted: the parts add up
                self._shell.sync(
                    Path(folder), f'{target}/site', excludes=('/*',),
                    includes=[f'/{entry}' for entry in entries],
                    timeout=self._job.timeouts.install, cancel=self._job.cancel)
        else:
            try:
                self._run(modules.install(
                    self._environment, self._setup, target, there.missing))
            except CommandError as error:
                self._discard(target)
                raise self._without(there, str(error)) from error
        left = self._ask(there.missing, f'{target}/site')
        if left.missing:
            self._discard(target)
            raise self._without(left, ': '.join(
                ['they were installed, and cannot be imported', *left.broken]))
        self._run(Command(('touch', f'{target}/complete'), what='note what is there'))

    def _discard(self, target: str) -> None:
        self._run(Command(('rm', '-rf', target), what='delete modules that fail'))

    def _has(self, target: str) -> bool:
        done = self._shell.run(
            Command(('test', '-e', f'{target}/complete'), what='look for what was brought before'),
            timeout=self._job.timeouts.command, check=False, cancel=self._job.cancel)
        return done.returncode == 0

    def _ask(self, names: Sequence[str], site: str = '') -> modules.Answer:
        return modules.answer(self._run(
            modules.ask(names, self._environment, self._setup, site)))

    def _run(self, command: Command) -> str:
        return self._shell.run(
            command, timeout=self._job.timeouts.install, cancel=self._job.cancel).stdout

    def _without(self, there: modules.Answer, why: str) -> PrerequisiteError:
        names = ' '.join(modules.MODULES[name].distributions[0] for name in there.missing)
        library = re.search(r'(\S+\.so[.\d]*): cannot open shared object file', why)
        if library:
            package = _PACKAGES.get(library[1])
            hint = (f'install {package} there with apt' if package else
                    f'install the package there that has it: apt-file search {library[1]}')
        elif there.architecture != platform.machine():
            hint = (f"take an image with them (pip install {names}): this robot's own are for "
                    f'{platform.machine()} processors, and the machine has {there.architecture}')
        elif there.python != sys.version_info[:2]:
            version = '.'.join(map(str, there.python))
            hint = (f'take an image with them (pip install {names}), or a robot with Python '
                    f'{version} as there, whose modules can be sent')
        else:
            hint = (f'install them on the robot with pip, so that they can be sent, or use a '
                    f'machine that has them: pip install {names}')
        return PrerequisiteError(
            f"'{self._job.name}' can't get {', '.join(there.missing)}, which programs there "
            f'import: {why}', hint)
