# SPDX-License-Identifier: Apache-2.0
"""Convert a process action, resolved on the robot, to the NodeSpec that a machine runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import contextlib
import os
from pathlib import Path
import re
import tempfile
from typing import Optional

from launch import LaunchContext, Substitution
from launch.actions import ExecuteLocal
from launch.conditions import evaluate_condition_expression
from launch.substitutions import FindExecutable, SubstitutionFailure, TextSubstitution
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions
from launch_ros.substitutions import ExecutableInPackage

from fogros2 import plan
from fogros2.describe.variables import added_folders, FOLDERS, LOCAL_VARIABLES, to_send
from fogros2.errors import ConfigurationError
from fogros2.host import workspace
from fogros2.host.programs import check_program
from fogros2.launch_internals import environment, private
from fogros2.model import MachineSpec, NodeSpec, Text, TextPart

# launch files import FogROS2 before the actions that they describe execute
environment.record()

#: ROS arguments followed by a file name; the file is sent to the machine.
_FILE_ARGUMENTS = ('--params-file', '--log-config-file')
#: Folders whose files any machine has, or a package installs.
_SYSTEM = ('/bin', '/dev', '/etc', '/lib', '/opt/ros', '/proc', '/sbin', '/sys', '/usr')


class ProgramName(Substitution):
    """The name of a program, which is looked up on the machine where it will run."""

    def __init__(
        self, name: list[Substitution], package: list[Substitution], here: Substitution,
    ) -> None:
        super().__init__()
        #: The substitution that looks it up on the robot.
        self.here = here
        self.name = name
        self.package = package

    def describe(self) -> str:
        """Return the name's own description."""
        return ' + '.join(part.describe() for part in self.name)

    def perform(self, context: LaunchContext) -> str:
        """Return the name."""
        return perform_substitutions(context, self.name)


def use_names_of_programs(action: ExecuteLocal) -> None:
    """
    Replace substitutions that look programs up on the robot by the names, in place.

    Of a package's programs, only the command's own: the paths of others become markers.
    """
    command = action.process_description.cmd
    for argument in command:
        for index, part in enumerate(argument):
            if isinstance(part, ExecutableInPackage):
                if argument is command[0] and len(argument) == 1:
                    argument[index] = ProgramName(part.executable, part.package, part)
            elif isinstance(part, FindExecutable):
                argument[index] = ProgramName(
                    normalize_to_list_of_substitutions(part.name), [], part)


@contextlib.contextmanager
def packages_of(folder: Optional[str], files: Optional[Path]) -> Iterator[None]:
    """
    Let substitutions find the packages of a workspace during the block, sourced or not.

    :param files: folder of temporary files, such as parameters; /tmp is cleaned after some days.
    """
    temporary = tempfile.tempdir
    if files is not None:
        tempfile.tempdir = str(files)
    before = os.environ.get('AMENT_PREFIX_PATH')
    known = before.split(os.pathsep) if before else []
    more = [prefix for prefix in workspace.prefixes(folder) if prefix not in known]
    if more:
        os.environ['AMENT_PREFIX_PATH'] = os.pathsep.join([*more, *known])
    try:
        yield
    finally:
        tempfile.tempdir = temporary
        if more and before is None:
            del os.environ['AMENT_PREFIX_PATH']
        elif more and before is not None:
            os.environ['AMENT_PREFIX_PATH'] = before


def robot_command(action: ExecuteLocal, context: LaunchContext) -> list[str]:
    """
    Return the command of a prepared action for the robot.

    :raises ConfigurationError: the program is not installed on the robot.
    """
    description = action.process_description
    command = list(description.final_cmd or ())
    first = len(command) - len(description.cmd)  # launch puts the prefix before the command
    for index, argument in enumerate(description.cmd, first):
        if any(isinstance(part, ProgramName) for part in argument):
            try:
                command[index] = perform_substitutions(context, [
                    part.here if isinstance(part, ProgramName) else part for part in argument])
            except (LookupError, SubstitutionFailure) as error:
                raise ConfigurationError(
                    f"{description.final_name} can't run on the robot: {error}",
                    'install it here too') from error
    return command


def program_of(action: ExecuteLocal) -> Optional[tuple[str, str]]:
    """Return the package and executable of a node that names them by plain texts, else None."""
    package, executable = (
        _plain(getattr(action, name, None)) for name in ('node_package', 'node_executable'))
    return (package, executable) if package and executable else None


def _plain(value: object) -> Optional[str]:
    """Return a text that no substitution changes."""
    parts = value if isinstance(value, (list, tuple)) else [value]
    texts = [part.text if isinstance(part, TextSubstitution) else part for part in parts]
    plain = [text for text in texts if isinstance(text, str)]
    return ''.join(plain) if len(plain) == len(texts) else None


def from_action(
    action: ExecuteLocal, context: LaunchContext, base: Mapping[str, str], spec: MachineSpec,
    launch_id: str, contained: bool = False, own_packages: bool = False, moved: bool = False,
) -> NodeSpec:
    """
    Convert a prepared action to a NodeSpec.

    If the node runs in a container, paths of the robot's ROS stay unchanged: only the machine
    knows the container's content.

    :param base: the environment before the launch changed it; changes are sent.
    :param own_packages: whether the machine may have packages that the robot does not have.
    :param moved: whether the workspace has another path on the machine.
    :raises ConfigurationError: a package, an executable or a parameter file is missing.
    """
    description = action.process_description
    texts = Texts(
        () if contained else plan.ament_prefixes(base), None if moved else spec.workspace)
    final = list(description.final_cmd or ())
    # launch puts the prefix before the command
    count = len(final) - len(description.cmd)
    prefix, final = final[:count], final[count:]
    package = executable = ''
    first = description.cmd[0]
    if len(first) == 1 and isinstance(first[0], ProgramName) and first[0].package:
        package = perform_substitutions(context, first[0].package)
        executable = final.pop(0)
        if not contained and not own_packages:
            check_program(package, executable, texts.prefixes, spec.workspace)
    files: dict[str, Text] = {}
    arguments = [texts.text(argument) for argument in final]
    for index in range(1, len(final)):
        if final[index - 1] in _FILE_ARGUMENTS:
            key = f'{len(files)}-{os.path.basename(final[index])}'
            files[key] = texts.text(_read(final[index]))
            arguments[index] = ({'file': key},)
    name = str(description.final_name)
    return NodeSpec(
        id=f'{name}.{launch_id}',
        name=name,
        package=package,
        executable=executable,
        arguments=tuple(arguments),
        prefix=tuple(map(texts.text, prefix)),
        files=files,
        environment={
            key: texts.text(value)
            for key, value in _environment(action, context, base).items()
            if contained or key not in FOLDERS},
        # a container has lists of its own
        folders={} if contained else {
            key: texts.text(value)
            for key, value in added_folders(description.final_env or {}, base).items()},
        cwd=None if description.final_cwd is None else texts.text(description.final_cwd),
        shell=action.shell,
        passes_signals=getattr(action, 'passes_signals', False),  # of an AddedProcess
        emulate_tty=_emulate_tty(action, context),
        respawn=bool(private.option(action, 'respawn')),
        respawn_delay=private.option(action, 'respawn_delay') or 0.0,
        respawn_max_retries=private.option(action, 'respawn_max_retries'),
        sigterm_timeout=float(perform_substitutions(context, action.sigterm_timeout)),
        sigkill_timeout=float(perform_substitutions(context, action.sigkill_timeout)),
    )


def robot_paths(node: NodeSpec, roots: Sequence[str], shared: Sequence[str]) -> list[str]:
    """
    Return the paths of the robot that a node gets: below folders, or of files outside the system.

    :param roots: the folders, such as ``$(env HOME)``.
    :param shared: folders that the machine has too.
    """
    texts = (*node.prefix, *node.arguments, *node.environment.values(), *node.folders.values(),
             *node.files.values(), node.cwd or '')
    parts = [part for text in texts for part in ((text,) if isinstance(text, str) else text)]
    paths = {path for part in parts if isinstance(part, str)
             for path in re.findall(r'(?<![\w./-])/[^\s\'",;:=]+', part)}
    roots = [root.rstrip('/') for root in roots if root.strip('/')]
    return sorted(path for path in paths if not plan.below(path, shared) and (
        plan.below(path, roots) or os.path.isfile(path) and not plan.below(path, _SYSTEM)))


def full_name(node: NodeSpec) -> str:
    """Return the full ROS name of a node: its remapped name, or else its program's name."""
    rules = dict(
        argument.split(':=', 1) for argument in reversed(node.arguments)  # the first rule wins
        if isinstance(argument, str) and argument.startswith(('__node:=', '__ns:=')))
    name = rules.get('__node', node.executable or node.name)
    return f"{rules.get('__ns', '').rstrip('/')}/{name}"


def _environment(
    action: ExecuteLocal, context: LaunchContext, base: Mapping[str, str],
) -> dict[str, str]:
    """Return the variables that the launch file set, for this process or for all processes."""
    description = action.process_description
    final: Mapping[str, str] = description.final_env or {}
    names = [perform_substitutions(context, key) for key, _ in description.additional_env or ()]
    added = to_send({name: final[name] for name in names}, base)
    if description.env is not None:
        # a complete environment: the machine adds it to the variables that ROS needs there
        listed = {key: value for key, value in final.items() if key not in names}
        return {**to_send(listed, base), **added}
    return {**{
        key: value for key, value in final.items()
        if (base.get(key) != value or environment.is_set(context, key))
        and key not in LOCAL_VARIABLES}, **added}


def _emulate_tty(action: ExecuteLocal, context: LaunchContext) -> bool:
    configured: Optional[str] = context.launch_configurations.get('emulate_tty')
    if configured is None:
        return bool(action.emulate_tty)
    return bool(evaluate_condition_expression(
        context, normalize_to_list_of_substitutions(configured)))


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(
            f"the file '{path}' of a cloud node can't be read: {error}",
            'it is read here and travels to the machine') from error


class Texts:
    """
    Replace the robot's package paths in texts by markers, which the machine resolves.

    ``/opt/ros/jazzy/share/demo/rviz.yaml`` becomes ``({'share': 'demo'}, '/rviz.yaml')``, and a
    path below ``lib/demo`` begins with ``{'prefix': 'demo'}``. The workspace has the same path on
    the machine, so its paths stay unchanged.

    :param prefixes: the robot's ament prefixes.
    """

    def __init__(self, prefixes: Sequence[str], workspace: Optional[str]) -> None:
        self.prefixes = list(prefixes)
        roots = sorted(
            {prefix.rstrip('/') for prefix in prefixes
             if workspace is None or not plan.below(prefix, [workspace])},
            key=len, reverse=True)
        self._pattern = re.compile(
            # '\n' may precede a path in a parameter file
            r'(?<!(?<!\\)[\w.-])(?P<prefix>{})/(?P<kind>share|lib)/(?P<package>\w+)'
            r'(?![\w.-])'.format('|'.join(re.escape(root) for root in roots) or r'(?!)'))

    def text(self, text: str) -> Text:
        """Return the text with markers, or the unchanged text if it needs none."""
        parts: list[TextPart] = []
        begin = 0
        for match in self._pattern.finditer(text):
            prefix, kind, package = match.group('prefix', 'kind', 'package')
            if not Path(prefix, 'share/ament_index/resource_index/packages', package).exists():
                continue
            parts.append(text[begin:match.start()])
            parts.append({'share' if kind == 'share' else 'prefix': package})
            # the machine looks up the package's prefix; the rest of the path is the same there
            begin = match.end() if kind == 'share' else match.end('prefix')
        if not parts:
            return text
        return tuple(part for part in (*parts, text[begin:]) if part)
