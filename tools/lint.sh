#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# ruff and the check of phrases over everything, mypy --strict over the packages; exit status 1 if
# one of them finds something.
set -u
cd "$(dirname "$0")/.."
status=0
tools/run.sh embedded -- ruff check . || status=1
tools/run.sh embedded -- python tools/phrases.py || status=1
tools/run.sh embedded -- mypy || status=1
(cd ros2_embedded && ../tools/run.sh embedded -- mypy --config-file ../pyproject.toml --exclude '^(test/|build/|setup.py)' .) || status=1
exit $status
