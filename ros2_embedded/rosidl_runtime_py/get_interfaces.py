# SPDX-License-Identifier: Apache-2.0
"""Which interfaces there are."""

from collections.abc import Iterable

from rosidl_embedded.definition import names, TABLES


def get_interface_packages() -> list[str]:
    """List the packages that have interfaces."""
    return sorted(table.stem for table in TABLES.glob('*.txt'))


def get_interfaces(package_names: Iterable[str] = ()) -> dict[str, list[str]]:
    """
    List the interfaces (``msg/Name``, ``srv/Name``) of packages, by default of all.

    :raises LookupError: if there is no such package.
    """
    known = get_interface_packages()
    found: dict[str, list[str]] = {}
    for package in package_names or known:
        if package not in known:
            raise LookupError(f"Unknown package '{package}'")
        found[package] = sorted(f'{kind}/{name}' for kind in ('msg', 'srv')
                                for name in names(package, kind))
    return found


def _of(kind: str, package_names: Iterable[str]) -> dict[str, list[str]]:
    listed = {package: [name for name in interfaces if name.startswith(f'{kind}/')]
              for package, interfaces in get_interfaces(package_names).items()}
    return {package: interfaces for package, interfaces in listed.items() if interfaces}


def get_message_interfaces(package_names: Iterable[str] = ()) -> dict[str, list[str]]:
    """List the messages (``msg/Name``) of packages, by default of all."""
    return _of('msg', package_names)


def get_service_interfaces(package_names: Iterable[str] = ()) -> dict[str, list[str]]:
    """List the services (``srv/Name``) of packages, by default of all."""
    return _of('srv', package_names)
