# SPDX-License-Identifier: Apache-2.0
"""Packages and resources below prefixes."""

from pathlib import Path

from ament_index_python import (
    get_package_prefix,
    get_package_share_directory,
    get_package_share_path,
    get_packages_with_prefixes,
    get_resource,
    get_resources,
    get_search_paths,
    has_resource,
    InvalidResourceNameError,
    InvalidResourceTypeNameError,
    PackageNotFoundError,
)
import pytest


@pytest.fixture
def overlay(tmp_path, monkeypatch):
    """A prefix before all others, with a package of its own and one that hides another."""
    index = tmp_path / 'share' / 'ament_index' / 'resource_index'
    for kind, name, content in (('packages', 'my_robot', ''), ('packages', 'rclpy', ''),
                                ('arms', 'left', 'seven joints'), ('arms', '.hidden', '')):
        (index / kind).mkdir(parents=True, exist_ok=True)
        (index / kind / name).write_text(content)
    (tmp_path / 'share' / 'my_robot').mkdir()
    monkeypatch.setenv('AMENT_PREFIX_PATH', ':'.join(
        [str(tmp_path), '/no/such/prefix', *get_search_paths()]))
    return tmp_path


def test_installed_packages_are_found():
    assert {'rclpy', 'std_msgs', 'launch', 'launch_ros'} <= set(get_packages_with_prefixes())
    share = Path(get_package_share_directory('rclpy'))
    assert share.is_dir() and share.parent.parent == Path(get_package_prefix('rclpy'))
    assert (share / 'package.xml').is_file()


def test_overlay_comes_first(overlay):
    assert get_search_paths()[0] == str(overlay)
    assert '/no/such/prefix' not in get_search_paths()
    assert get_package_prefix('my_robot') == get_package_prefix('rclpy') == str(overlay)
    assert get_package_share_path('my_robot') == overlay / 'share' / 'my_robot'
    assert get_package_prefix('std_msgs') != str(overlay)
    assert get_resources('arms') == {'left': str(overlay)}
    assert get_resource('arms', 'left') == ('seven joints', str(overlay))
    assert has_resource('arms', 'left') == str(overlay) and not has_resource('arms', 'right')
    with pytest.warns(UserWarning, match='does not exist'):
        get_package_share_directory('rclpy')


def test_missing_package_or_resource_is_an_error(overlay):
    with pytest.raises(PackageNotFoundError, match="package 'nothing' not found, searching"):
        get_package_prefix('nothing')
    with pytest.raises(ValueError, match="'not a name' is not a valid package name"):
        get_package_prefix('not a name')
    with pytest.raises(LookupError, match="Could not find the resource 'right'"):
        get_resource('arms', 'right')
    with pytest.raises(InvalidResourceNameError):
        get_resource('arms', '../left')
    with pytest.raises(InvalidResourceTypeNameError):
        get_resources('../arms')
