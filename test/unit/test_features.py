# SPDX-License-Identifier: Apache-2.0
"""Keywords of features in all forms of launch files, and their steps; results that come home."""

from __future__ import annotations

from collections.abc import Callable
import inspect
import io
import os
from pathlib import Path
import shutil
import time
from types import SimpleNamespace
from typing import Any, Optional, TYPE_CHECKING

from launch import LaunchContext
from launch.frontend import Parser
from launch.substitutions import LaunchConfiguration
import pytest

from fogros2 import AWSCloudInstance, ContainerInstance, plugin_system, process
from fogros2.deploy import checks
from fogros2.describe import defaults, features, keywords
from fogros2.describe.overrides import Overrides
from fogros2.errors import (
    ConfigurationError,
    ConnectError,
    DeadlineExceeded,
    ShellError,
    StoreError,
)
from fogros2.feature import Feature
from fogros2.model import MachineSpec
from fogros2.report import silent
from fogros2.store import robot_id
from fogros2_features import results
from fogros2_features.results import Results
from fogros2_testing.fakes import FakeProvider, FakeRunning
from fogros2_testing.plugins import instead

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.describe.machines import Bool, Value

BAGS = {'results': {'fetch': ['~/bags', '/var/log/x'], 'fetch_limit': '2GB'}}


def spec(machine: Any, *overrides: str, **arguments: str) -> MachineSpec:
    context = LaunchContext()
    context.environment.update(os.environ)
    context.launch_configurations.update(arguments)
    return defaults.resolved(machine, Overrides(overrides) if overrides else None, context)


def loaded(kind: str, text: str) -> Any:
    source = io.StringIO(text.strip())
    source.name = f'test.launch.{kind}'
    entity, parser = Parser.load(source)
    return parser.parse_description(entity).entities[0].machine


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the home of robot and machine, which is empty and without defaults."""
    monkeypatch.setenv('HOME', str(tmp_path))
    monkeypatch.setitem(process._ENVIRONMENT, 'HOME', str(tmp_path))
    monkeypatch.setenv('XDG_CONFIG_HOME', str(tmp_path / 'config'))
    return tmp_path


# -- keywords ------------------------------------------------------------------------------------


@pytest.mark.parametrize('machine', [
    lambda: ContainerInstance(name='a', fetch=['~/bags', '/var/log/x'], fetch_limit='2GB'),
    lambda: ContainerInstance(name='a', fetch=('$HOME/bags', '/var/log/x'), fetch_limit='2GB'),
    lambda: loaded('xml', '<launch><fog_machine name="a" provider="container" '
                   'fetch="~/bags, /var/log/x" fetch_limit="2GB"/></launch>'),
    lambda: loaded('yaml', 'launch: [{fog_machine: {name: a, provider: container, '
                   'fetch: [~/bags, /var/log/x], fetch_limit: 2GB}}]')])
def test_keywords_of_a_feature_are_those_of_machines(machine: Any) -> None:
    found = spec(machine()).features['results']
    assert Results.options(**found) == Results.options(**BAGS['results'])


def test_values_may_be_substitutions() -> None:
    made = AWSCloudInstance(name='a', fetch=[['~/', LaunchConfiguration('folder')]])
    assert spec(made, folder='maps').features == {'results': {'fetch': ['~/maps']}}


def test_an_empty_text_is_no_value() -> None:
    made = ContainerInstance(name='a', fetch=['~/bags'], fetch_to='',
                             fetch_limit=LaunchConfiguration('limit'))
    assert spec(made, limit='').features == {'results': {'fetch': ['~/bags']}}


def test_command_line_and_defaults_know_the_keywords(home: Path) -> None:
    path = home / 'config/fogros2/fogros2.toml'
    path.parent.mkdir(parents=True)
    path.write_text("fetch_limit = '5GB'\n[container]\nfetch_to = '/tmp/here'\n")
    made = ContainerInstance(name='a', fetch=['~/bags'])
    assert spec(made, 'a=container,fetch_limit=1GB').features == {'results': {
        'fetch': ['~/bags'], 'fetch_limit': '1GB', 'fetch_to': '/tmp/here'}}
    assert spec(AWSCloudInstance(name='a')).features == {'results': {'fetch_limit': '5GB'}}
    path.write_text('fetch = 3\n')
    with pytest.raises(ConfigurationError, match='fetch=3 has the wrong type'):
        spec(made)


@pytest.mark.parametrize(('given', 'said'), [
    ({'fetch': '~/bags'}, "fetch='~/bags' is no list"),
    ({'fetch': ['bags']}, "fetch='bags' is no folder"),
    ({'fetch': ['~/../x']}, "fetch='~/../x' is no folder"),
    ({'record': ['tf']}, "'tf' is not the full name of a topic"),
    ({'fetch_to': 'here'}, "fetch_to='here' is no absolute path"),
    ({'fetch_limit': '2 apples'}, "fetch_limit='2 apples' is no number of bytes"),
    ({'fetch_limit': 0}, "fetch_limit='0' is no number of bytes"),
    ({'fetsch': ['~/bags']}, "no attribute 'fetsch'.*did you mean 'fetch'")])
def test_wrong_values_are_refused(given: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        ContainerInstance(name='a', **given)


def test_keyword_of_a_feature_is_no_keyword_of_a_machine() -> None:
    for provider in plugin_system.names('fogros2.machine'):
        for base in keywords.machine_class(provider).__mro__[:-1]:
            assert not {*inspect.signature(base).parameters} & {*features.keywords()}


# -- steps ---------------------------------------------------------------------------------------


@pytest.fixture
def check(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Return a function that checks a machine with features."""
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(shell_kind='local'))
    return lambda **given: checks.check(
        MachineSpec('a', 'fake', features=given), FakeProvider(), environment={},
        programs=(), report=silent)


class Counting(Feature):
    """Notes its calls."""

    calls: list[Any] = []

    @staticmethod
    def options(
        count: Optional[Value] = None, deep: Optional[Bool] = None,
        word: SomeSubstitutionsType | None = None,
    ) -> tuple[Any, Any]:
        return count, deep

    def check(self, spec: MachineSpec, own: tuple[Any, Any]) -> None:
        self.calls.append(('check', spec.name, own))


def test_a_machine_is_checked_by_its_features(
    check: Callable[..., None], monkeypatch: pytest.MonkeyPatch,
) -> None:
    instead(monkeypatch, 'fogros2.feature', {'counting': Counting})
    check(counting={'count': 3})
    assert Counting.calls == [('check', 'a', (3, None))]


def test_values_have_the_types_of_their_annotations(
    home: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    instead(monkeypatch, 'fogros2.feature', {'counting': Counting})
    path = home / 'config/fogros2/fogros2.toml'
    path.parent.mkdir(parents=True)
    path.write_text("count = '3'\n")
    made = ContainerInstance(name='a', deep='false')
    assert spec(made).features == {'counting': {'count': 3, 'deep': False}}
    made = ContainerInstance(name='a', count='3', word=['a', LaunchConfiguration('n')])
    assert spec(made, n='b').features == {'counting': {'count': 3, 'word': 'ab'}}
    assert spec(ContainerInstance(name='a', word=['a', 'b'])).features['counting'] == {
        'count': 3, 'word': 'ab'}
    made = ContainerInstance(name='a', count=LaunchConfiguration('n'))
    assert spec(made, n='2.5').features == {'counting': {'count': 2.5}}
    with pytest.raises(ConfigurationError, match="count: 'few' is no number"):
        ContainerInstance(name='a', count='few')
    path.write_text("count = 'few'\n")
    with pytest.raises(ConfigurationError, match="fogros2.toml: count: 'few' is no number"):
        spec(made)


class Image(Feature):
    """Has a keyword of some machines."""

    @staticmethod
    def options(image: Optional[SomeSubstitutionsType] = None) -> None:
        pass


def test_a_feature_cannot_take_a_keyword_of_a_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    instead(monkeypatch, 'fogros2.feature', {'image': Image, 'none': Feature})
    with pytest.raises(ConfigurationError, match="the keyword 'image' of a ContainerInstance"):
        spec(ContainerInstance(name='a'), 'a=container,image=x')


def test_two_features_with_one_keyword_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    instead(monkeypatch, 'fogros2.feature', {'counting': Counting, 'another': Counting})
    with pytest.raises(ConfigurationError, match="'another' and another have the same keyword"):
        ContainerInstance(name='a', count=3)


def test_a_feature_that_is_not_installed_is_one_error(check: Callable[..., None]) -> None:
    with pytest.raises(ConfigurationError, match="there is no feature 'gone'"):
        check(gone={})


def test_keyword_of_another_version_is_one_error(
    check: Callable[..., None], monkeypatch: pytest.MonkeyPatch,
) -> None:
    instead(monkeypatch, 'fogros2.feature', {'counting': Counting})
    with pytest.raises(ConfigurationError, match="'counting' has no keyword 'grace'"):
        check(counting={'count': 3, 'grace': 1})


# -- results -------------------------------------------------------------------------------------


def brought(running: FakeRunning, **keywords: Any) -> list[str]:
    """Run the end of a launch; return what came home, by path and content."""
    own = Results.options(**keywords)
    with Results().machine(running, own):
        assert not own.target.exists()
    return sorted(f'{path.relative_to(own.target).as_posix().partition("/")[2]}={path.read_text()}'
                  for path in own.target.rglob('*') if path.is_file())


def test_folders_come_home_when_the_launch_ends(home: Path) -> None:
    for name in ('bags/deep/one', 'maps/one', 'other/maps/two'):
        (home / name).parent.mkdir(parents=True)
        (home / name).write_text(name)
    running = FakeRunning()
    found = brought(running, fetch=['~/bags', '~/none'])
    assert found == ['bags/deep/one=bags/deep/one']
    assert f' MB to {home}/fogros2/a-20' in running.details[0]
    assert running.details[0].endswith(', no ~/none there')
    (home / 'maps-2').mkdir()
    (home / 'maps-2/three').write_text('3')
    found = brought(running, fetch=['~/maps', '~/other/maps', '~/maps-2'],
                    fetch_to=str(home / 'two'))
    assert found == ['maps-2-2/three=3', 'maps-2/two=other/maps/two', 'maps/one=maps/one']


def test_robots_that_end_in_one_second_get_two_folders(
    home: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    (home / 'bags').mkdir()
    monkeypatch.setattr(time, 'strftime', lambda form: '20260101-000000')
    for _ in range(2):
        with Results().machine(FakeRunning(), Results.options(fetch=['~/bags'])):
            pass
    assert sorted(path.name for path in (home / 'fogros2').iterdir()) == [
        'a-20260101-000000', 'a-20260101-000000-2']


def test_one_bad_folder_does_not_keep_the_others(
    home: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ('bags', 'maps'):
        (home / name).mkdir()
        (home / name / 'one').write_text(name)
    running = FakeRunning()
    fetch = running.shell.fetch

    def broken(source: str, *words: Any, **more: Any) -> None:
        if source == '~/bags':
            raise ShellError('~/bags/one can not be read')
        fetch(source, *words, **more)

    monkeypatch.setattr(running.shell, 'fetch', broken)
    with pytest.raises(ShellError, match='can not be read'):
        brought(running, fetch=['~/bags', '~/maps'])
    assert [path.read_text() for path in home.glob('fogros2/*/maps/one')] == ['maps']


def test_machine_without_the_folders_is_said(home: Path) -> None:
    running = FakeRunning()
    assert brought(running, fetch=['~/bags']) == []
    assert running.details == ['no ~/bags there'] and not (home / 'fogros2').exists()


def test_too_large_folders_do_not_come_home(home: Path) -> None:
    """A folder that is a link counts with its content."""
    (home / 'data').mkdir()
    (home / 'data/one').write_bytes(bytes(200_000))
    (home / 'bags').symlink_to('data')
    with pytest.raises(ShellError, match=r'~/bags of .a. have 0.0002\d* GB, more than'):
        brought(FakeRunning(), fetch=['~/bags'], fetch_limit='100kB')
    assert not (home / 'fogros2').exists()


def test_folder_without_room_on_the_robot_keeps_no_other(
    home: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, size in (('huge', 900_000), ('bags', 200_000), ('maps', 3)):
        (home / name).mkdir()
        (home / name / 'one').write_text('x' * size)
    monkeypatch.setattr(results, 'SPARE', 300_000.0)
    monkeypatch.setattr(shutil, 'disk_usage', lambda path: SimpleNamespace(
        free=400_000.0 - sum(file.stat().st_size for file in Path(path).rglob('*/one'))))
    with pytest.raises(ShellError, match='^~/bags, ~/huge of .a. did not come home') as caught:
        brought(FakeRunning(), fetch=['~/huge', '~/bags', '~/maps'])
    assert 'fetch_to=' in caught.value.hint
    assert [path.read_text() for path in home.glob('fogros2/*/*/one')] == ['xxx']
    assert not [*home.glob('fogros2/*/huge')]


def test_many_small_files_come_home(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each takes a block of the disk, so together they take more than twice their size."""
    monkeypatch.setattr(results, 'SLACK', 0)
    (home / 'bags').mkdir()
    for number in range(100):
        (home / f'bags/{number}').write_text('1')
    assert len(brought(FakeRunning(), fetch=['~/bags'], fetch_limit='1MB')) == 100


def test_hard_links_count_as_the_files_that_they_become(home: Path) -> None:
    (home / 'bags').mkdir()
    (home / 'bags/1').write_text(100_000 * '1')
    for number in range(2, 5):
        (home / f'bags/{number}').hardlink_to(home / 'bags/1')
    with pytest.raises(ShellError, match=r'~/bags of .a. have 0.0004\d* GB, more than'):
        brought(FakeRunning(), fetch=['~/bags'], fetch_limit='300kB')
    assert len(brought(FakeRunning(), fetch=['~/bags'], fetch_limit='500kB')) == 4


def test_broken_connection_is_tried_again(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (home / 'bags').mkdir()
    (home / 'bags/one').write_text('1')
    running, tries = FakeRunning(), []
    fetch = running.shell.fetch

    def broken(*words: Any, **more: Any) -> None:
        tries.append(words)
        if len(tries) < 3:
            raise ConnectError('the connection was lost')
        fetch(*words, **more)

    monkeypatch.setattr(running.shell, 'fetch', broken)
    assert brought(running, fetch=['~/bags']) == ['bags/one=1'] and len(tries) == 3
    tries[:] = []
    running.lost = 'it was deleted'
    assert brought(running, fetch=['~/bags'], fetch_to=str(home / 'two')) == [] and not tries


def test_link_that_drops_often_brings_all_home(
    home: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each attempt brings a part: only attempts that bring nothing count."""
    (home / 'bags').mkdir()
    errors = [ConnectError('it was lost'), DeadlineExceeded('nothing came')] * results.ATTEMPTS
    running = FakeRunning()

    def dropped(source: str, target: Path, **more: Any) -> None:
        (target / str(len(errors))).touch()
        if errors:
            raise errors.pop()

    monkeypatch.setattr(running.shell, 'fetch', dropped)
    assert len(brought(running, fetch=['~/bags'])) == 2 * results.ATTEMPTS + 1


def test_machine_that_takes_back_what_it_sent_holds_no_end(
    home: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    (home / 'bags').mkdir()
    running, sent = FakeRunning(), [True, False] * 20

    def withdrawn(source: str, target: Path, **more: Any) -> None:
        if sent.pop():
            (target / 'x').unlink(missing_ok=True)
        else:
            (target / 'x').touch()
        raise ConnectError('it was lost')

    monkeypatch.setattr(running.shell, 'fetch', withdrawn)
    with pytest.raises(ConnectError):
        brought(running, fetch=['~/bags'])


def test_copy_ends_at_a_time_that_follows_from_its_size(
    home: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A hijacked machine sends a little now and then."""
    (home / 'bags').mkdir()
    running = FakeRunning()

    def slow(source: str, target: Path, *, cancel: Any, **more: Any) -> None:
        assert not list(target.iterdir()), 'one attempt'
        (target / 'a little').touch()
        assert not cancel.is_set()
        begin = time.monotonic()
        later = begin + results.TIMEOUT + 1e9 / results.SLOWEST
        monkeypatch.setattr(time, 'monotonic', lambda: later - 1.0)
        assert not cancel.is_set()
        monkeypatch.setattr(time, 'monotonic', lambda: later + 1.0)
        cancel.is_set()

    monkeypatch.setattr(running.shell, 'fetch', slow)
    with pytest.raises(DeadlineExceeded, match='too little'):
        results._copy(running, '~/bags', home / 'target', size=int(1e9), limit=1)


def test_folder_on_the_robot_is_checked_before(home: Path) -> None:
    (home / 'file').touch()
    own = Results.options(fetch=['~/bags'], fetch_to=str(home / 'file/deep'))
    with pytest.raises(ConfigurationError, match="fetch_to='.*file/deep' can't be written"):
        Results().check(MachineSpec('a', 'fake'), own)
    Results().check(MachineSpec('a', 'fake'), Results.options(fetch=['~/bags']))


@pytest.mark.skipif(os.geteuid() != 0, reason='only root can give a folder to another account')
def test_folder_of_another_account_gets_no_results(home: Path) -> None:
    (home / 'bags').mkdir()
    (home / 'theirs').mkdir()
    os.chown(home / 'theirs', 65534, 65534)
    given = {'fetch': ['~/bags'], 'fetch_to': str(home / 'theirs')}
    with pytest.raises(StoreError, match='theirs belongs to another account'):
        Results().check(MachineSpec('a', 'fake'), Results.options(**given))
    with pytest.raises(StoreError, match='another account'), \
            Results().machine(FakeRunning(), Results.options(**given)):
        pass
    assert not [*(home / 'theirs').iterdir()]


def test_lost_connection_is_not_tried_for_each_folder(
    home: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    tries = []

    def broken(source: str, *words: Any, **more: Any) -> None:
        tries.append(source)
        raise ConnectError('the connection was lost')

    for name in ('bags', 'maps'):
        (home / name).mkdir()
    running = FakeRunning()
    monkeypatch.setattr(running.shell, 'fetch', broken)
    with pytest.raises(ConnectError):
        brought(running, fetch=['~/bags', '~/maps'])
    assert tries == ['~/bags'] * results.ATTEMPTS


def test_machine_cannot_report_a_size_that_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    running = FakeRunning()
    monkeypatch.setattr(running.shell, 'run', lambda *_, **__: SimpleNamespace(stdout='\x1b[2J'))
    with pytest.raises(ShellError, match='size of ~/bags'):
        brought(running, fetch=['~/bags'])


def test_recorded_topics_have_a_program_beside_the_nodes() -> None:
    own = Results.options(record=['/tf', '/scan', '/tf'])
    program, = Results().beside(MachineSpec('mapper', 'container'), own)
    assert (program.package, program.executable) == ('fogros2', 'record')
    robot = robot_id().rpartition('-')[2]
    assert program.arguments == (
        f'~/fogros2-mapper-{robot}/recordings', '/tf', '/scan', '--ros-args')
    assert Results().beside(MachineSpec('mapper', 'container'), Results.options()) == []


def test_recordings_come_home_once(home: Path) -> None:
    folder = home / results.recordings_of('a')[2:] / 'recordings'
    folder.mkdir(parents=True)
    (folder / '1.mcap').write_text('tf')
    other = home / 'fogros2-a-0f0f0f0f/recordings/2.mcap'  # of another robot that shares the host
    other.parent.mkdir(parents=True)
    other.touch()
    assert brought(FakeRunning(), record=['/tf']) == ['recordings/1.mcap=tf']
    assert not folder.parent.exists() and other.exists()
    folder.mkdir(parents=True)
    (folder / '2.mcap').write_text('too much')
    with pytest.raises(ShellError, match='more than fetch_limit='):
        brought(FakeRunning(), record=['/tf'], fetch_limit='1', fetch_to=str(home / 'two'))
    assert (folder / '2.mcap').exists()
