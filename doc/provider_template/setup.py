# SPDX-License-Identifier: Apache-2.0
from setuptools import setup

setup(
    name='fogros2-shelf',
    version='0.1.0',
    packages=['fogros2_shelf'],
    install_requires=['fogros2'],
    entry_points={
        'fogros2.provider': ['shelf = fogros2_shelf:ShelfProvider'],
        'fogros2.machine': ['shelf = fogros2_shelf.machines:ShelfInstance'],
    },
)
