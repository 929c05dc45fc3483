# SPDX-License-Identifier: Apache-2.0
"""Brings what nodes that handle images import to a machine without it, once, when it is needed."""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
from pathlib import Path
import threading

from fogros2 import bootstrap, modules
from fogros2.deploy.job import Job
from fogros2.errors import CommandError, PrerequisiteError
from fogros2.model import Command, NodeSpec
from fogros2.shell import Shell


class Equipment:
    """
    What one machine has of the modules; thread-safe.

    :param ros: how nodes run there.
    """

    def __init__(self, job: Job, shell: Shell, ros: bootstrap.RosInstall) -> None:
        self._job = job
        self._shell = shell
        self._environment = {**ros.environment, **job.spec.environment}
        self._setup = ros.setup
        self._home = ros.facts.home
        self._lock = threading.Lock()
        self._complete = False
        #: Where the modules lie that the machine lacked.
        self._folder = ''

    def fitted(self, nodes: Sequence[NodeSpec]) -> list[NodeSpec]:
        """
        Return nodes that find what they import, brought now if none before them needed it.

        :raises PrerequisiteError: the machine can't have it.
        """
        if not modules.needed_by((node.package, node.executable) for node in nodes):
            return list(nodes)
        self.ensure()
        return [modules.fitted(node, self._folder) for node in nodes]

    def ensure(self) -> None:
        """
        Bring what is missing, in the first call.

        :raises PrerequisiteError: the machine can't have it.
        """
        with self._lock:
            if self._complete:
                return
            with self._job.step('modules for images') as detail:
                detail.append(self._bring())
            self._complete = True

    def _bring(self) -> str:
        there = self._ask()
        if not there.missing:
            return 'there already'
        copy = modules.copy(there)
        target = modules.folder(self._home, there, copy.versions if copy else ())
        if self._has(target):
            self._folder = target
            return 'there from before'
        if copy is not None:
            self._shell.sync(
                Path(copy.folder), f'{target}/site', excludes=('/*',),
                includes=[f'/{entry}' for entry in copy.entries],
                timeout=self._job.timeouts.install, cancel=self._job.cancel)
        else:
            try:
                self._run(modules.install(
                    self._environment, self._setup, target, there.missing))
            except CommandError as error:
                raise self._without(there, str(error)) from error
        left = self._ask(f'{target}/site').missing
        if left:
            raise self._without(dataclasses.replace(there, missing=left),
                                'they were installed, and can not be imported')
        self._run(Command(('touch', f'{target}/complete'), what='note what is there'))
        self._folder = target
        return f"{', '.join(there.missing)} {'installed' if copy is None else 'sent'}"

    def _has(self, target: str) -> bool:
        done = self._shell.run(
            Command(('test', '-e', f'{target}/complete'), what='look for modules'),
            timeout=self._job.timeouts.command, check=False, cancel=self._job.cancel)
        return done.returncode == 0

    def _ask(self, site: str = '') -> modules.Answer:
        return modules.answer(self._run(modules.ask(self._environment, self._setup, site)))

    def _run(self, command: Command) -> str:
        return self._shell.run(
            command, timeout=self._job.timeouts.install, cancel=self._job.cancel).stdout

    def _without(self, there: modules.Answer, why: str) -> PrerequisiteError:
        names = ' '.join(m.distributions[0] for m in modules.MODULES if m.name in there.missing)
        version = '.'.join(map(str, there.python))
        return PrerequisiteError(
            f"'{self._job.name}' can't get {', '.join(there.missing)}, which streams of images "
            f'take: {why}',
            f'take an image with them (pip install {names}), or a robot with Python {version} as '
            'there, whose modules can be sent')
