# SPDX-License-Identifier: Apache-2.0
"""What the documentation shows is true: launch files build, commands parse, links lead on."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
import re
import runpy
import shlex

from launch import LaunchDescription
from launch.frontend import Parser
import pytest

import fogros2
from fogros2.describe import overrides
from fogros2.provider import Capabilities, Provider
from fogros2.provider.kubernetes import manifests
from fogros2.provider.vm.cloud import VmCloud
from fogros2.waiting import Timeouts

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / 'README.md', *sorted((ROOT / 'doc').rglob('*.md'))]
#: What users read: all but the pages for developers, and what is generated.
MANUAL = [page for page in PAGES if 'developers' not in page.parts
          and page.name not in ('README.md', 'command_line.md')]
#: Pages without a limit of words of their own: lists that readers search.
REFERENCES = ('not_verified.md', 'paper.md', 'paper_tables.md', 'security.md',
              'security_attackers.md')
_BLOCK = re.compile(r'^( *)```(\w+)\n(.*?)^\1```$', re.MULTILINE | re.DOTALL)


def blocks(kind: str) -> list[pytest.param]:
    """Return the code blocks of a kind, each named by its page and line."""
    found = []
    for page in PAGES:
        text = page.read_text()
        for block in _BLOCK.finditer(text):
            if block[2] == kind:
                line = text[:block.start()].count('\n') + 1
                found.append(pytest.param(
                    '\n'.join(row.removeprefix(block[1]) for row in block[3].splitlines()) + '\n',
                    id=f'{page.relative_to(ROOT)}:{line}'))
    return found


@pytest.mark.parametrize('text', blocks('python'))
def test_python_of_a_page_runs(text, tmp_path):
    """A launch file is built, which does nothing; so is what a page shows of one."""
    compile(text, 'block', 'exec')
    path = tmp_path / 'x.launch.py'
    path.write_text(text)
    if 'def generate_launch_description' in text:
        description = runpy.run_path(str(path))['generate_launch_description']()
        assert isinstance(description, LaunchDescription)
        assert description.entities
    elif not re.search('Ec2Box|GceBox|AzureBox', text):  # test/integration makes computers
        machines = {name: fogros2.ContainerInstance(name=name)
                    for name in ('machine', 'mapper', 'planner')}
        runpy.run_path(str(path), {
            **{name: getattr(fogros2, name) for name in fogros2.__all__}, **machines})


@pytest.mark.parametrize('text', [*blocks('xml'), *blocks('yaml')])
def test_launch_file_of_a_page_is_parsed(text, tmp_path):
    is_launch = text.lstrip().startswith(('<launch', '<?xml', 'launch:'))
    if not is_launch:
        text = f'<launch>{text}</launch>' if text.lstrip().startswith('<') else text
    path = tmp_path / ('x.launch.xml' if text.lstrip().startswith('<') else 'x.launch.yaml')
    path.write_text(text)
    root, parser = Parser.load(str(path))
    assert parser.parse_description(root).entities


def commands() -> list[pytest.param]:
    found = []
    for block in blocks('console'):
        text = block.values[0].replace('\\\n', ' ')
        for line in text.splitlines():
            if line.startswith('$ '):
                found.append(pytest.param(line[2:].partition(' # ')[0], id=f'{block.id} {line}'))
    return found


@pytest.mark.parametrize('line', commands())
def test_command_of_a_page_is_accepted(line, monkeypatch):
    words = shlex.split(re.sub(r'\$\(.*?\)', 'x', line))
    if words[:2] == ['ros2', 'fog'] and len(words) > 2:
        from ros2cli.plugin_system import instantiate_extensions
        monkeypatch.setattr(argparse.ArgumentParser, 'error', _refuse)
        verb = instantiate_extensions('fogros2.verb')[words[2]]
        parser = argparse.ArgumentParser()
        verb.add_arguments(parser, 'ros2 fog')
        parser.parse_args(words[3:])
    elif words[:2] == ['ros2', 'launch']:
        for option, value in zip(words, words[1:]):
            if option == '--machine':
                overrides.parse(value)
    elif words[0] == 'make':
        targets = re.findall(r'^([a-z-]+):', (ROOT / 'Makefile').read_text(), re.MULTILINE)
        assert words[1] in targets
    elif words[:2] == ['pip', 'install']:
        extras = {name for word in words[2:] for name in re.findall(r'[a-z-]+', word[1:])
                  if word.startswith('.[')}
        assert extras <= set(re.findall(r"^        '([a-z-]+)': ", (ROOT / 'setup.py').read_text(),
                                        re.MULTILINE))
    elif words[0] == 'sudo' and words[1].startswith('./'):
        assert os.access(ROOT / words[1], os.X_OK)
    else:
        # other people's programs, which take an account, a network or a workspace
        assert words[0] in ('.', 'aws', 'colcon', 'docker', 'echo', 'git', 'kubectl', 'npm',
                            'rosdep', 'source', 'ssh', 'sudo', 'PIP_BREAK_SYSTEM_PACKAGES=1',
                            'python', 'python3'), line


def test_extras_are_spelt_as_every_pip_takes_them():
    """Debian 12's pip finds no extra whose name has an underscore."""
    text = (ROOT / 'setup.py').read_text().partition('extras_require={')[2].partition('    },')[0]
    names = re.findall(r"^        '(.*?)': ", text, re.MULTILINE)
    assert 'point-clouds' in names
    assert all(re.fullmatch('[a-z]+(-[a-z]+)*', name) for name in names)


def _refuse(self: argparse.ArgumentParser, message: str) -> None:
    raise AssertionError(message)


@pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_of_a_page_lead_to_something(page):
    """Files, and headings in them, are there; nothing is asked of the network."""
    for target in re.findall(r'\]\(([^)\s]+)\)', page.read_text()):
        if re.match(r'[a-z]+:', target):
            continue
        name, _, anchor = target.partition('#')
        path = (page.parent / name).resolve() if name else page
        generated = ROOT / 'doc/reference/command_line.md'
        assert path.exists() or path == generated, f'{page.name}: {target}'
        if anchor and path.suffix == '.md' and path.exists():
            anchors = [re.sub(r'[^\w\- ]', '', heading.strip().lower()).replace(' ', '-')
                       for heading in re.findall(r'^#+ (.*)$', path.read_text(), re.MULTILINE)]
            assert anchor in anchors, f'{page.name}: {target}'


@pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_page_that_explains_is_short(page):
    name = page.relative_to(ROOT).as_posix()
    if not name.startswith('doc/reference/') and page.name not in REFERENCES:
        assert len(page.read_text().split()) <= (800 if name == 'README.md' else 1500)


def test_manual_has_at_most_25000_words():
    assert 15_000 < sum(len(page.read_text().split()) for page in MANUAL) <= 25_000


def test_change_log_has_at_most_600_words():
    assert len((ROOT / 'CHANGELOG.rst').read_text().split()) <= 600


@pytest.mark.parametrize('page', [
    'README.md', 'doc/machines.md', 'doc/safety.md', 'doc/developers/security.md',
    'doc/developers/machine_life.md',
    'doc/troubleshooting.md', 'fogros2/describe/machines.py'])
def test_end_of_a_machine_that_was_never_reached_is_stated(page):
    text = ' '.join(re.sub(r'\]\(.*?\)', '', (ROOT / page).read_text()).split())
    allowance = Timeouts()
    assert f'{(allowance.boot + allowance.ssh) / 60:g} minutes after' in text
    assert f'a pod: {manifests.BOOT / 60:g}' in text


def test_all_benchmark_results_are_listed():
    page = (ROOT / 'doc/developers/figures.md').read_text()
    shown = set(re.findall(r'benchmarks/results/(.*\.md)', page))
    assert shown == {path.name for path in (ROOT / 'benchmarks/results').glob('*.md')}


def test_printed_tables_of_the_paper_are_those_of_the_benchmarks():
    paper = runpy.run_path(str(ROOT / 'benchmarks/figures/paper.py'))
    page = (ROOT / 'doc/developers/paper_tables.md').read_text()
    cells = [re.split(r' *\| *', line.strip('| ')) for line in page.splitlines()
             if line.startswith('|')]
    values = [[float(cell) for cell in row[1:] if re.fullmatch(r'[\d.]+', cell)] for row in cells]
    for figures in (*paper['STREAMING'].values(), *paper['SLAM'].values(),
                    *paper['REGIONS'].values()):
        assert [*figures] in values, figures
    for row in (*paper['GRASPS'].values(), *paper['PLANS'].values()):
        printed = [row.robot, row.compute, row.fogros1_network, row.fogros1_total, row.network,
                   row.total]
        assert [one for one in printed if one is not None] in values, row
    assert all(any(text in line for line in page.splitlines() if line.startswith('|'))
               for text in paper['STARTUP'].values())


@pytest.mark.parametrize('page', [
    'architecture', 'architecture_features', 'decisions', 'machine_life', 'measured', 'paper',
    'security'])
def test_files_that_a_page_names_exist(page):
    text = (ROOT / f'doc/developers/{page}.md').read_text()
    text = re.sub('```.*?```', '', text, flags=re.DOTALL)
    named = re.findall(r'`([\w./]+/[\w.]*)`' if page == 'paper' else r'`([\w/]+(?:/|\.py))`', text)
    assert named and [name for name in named if not (ROOT / name).exists()
                      and not (ROOT / 'fogros2' / name).exists()
                      and not name.startswith('.cache')] == []


@pytest.mark.parametrize(('kind', 'page'), [
    (Provider, 'providers.md'), (Capabilities, 'providers.md'), (VmCloud, 'providers_vm.md')])
def test_page_names_all_that_a_provider_may_have(kind, page):
    text = (ROOT / 'doc/developers' / page).read_text() \
        + (ROOT / 'doc/provider_template/fogros2_meadow.py').read_text()
    assert [name for name in vars(kind)
            if not name.startswith('_') and not re.search(rf'\b{name}\b', text)] == []


def test_providers_import_what_their_page_says():
    page = (ROOT / 'doc/developers/providers.md').read_text()
    own = ('aws', 'azure', 'container', 'gcp', 'kubernetes', 'ssh', 'vm')
    for path in (ROOT / 'fogros2' / 'provider').rglob('*.py'):
        for first, second, names in re.findall(
                r'^ *from fogros2\.?(\w*)\.?(\w*)\S* import (.*)', path.read_text(), re.MULTILINE):
            if first == 'provider' and not second or second.startswith(own):
                continue
            for name in [first] if first else names.split(', '):
                module = f'fogros2.{name}' + (f'.{second}' if name == 'provider' else '')
                assert f'`{module}`' in page, f'{path}: {module}'
