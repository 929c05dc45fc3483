# SPDX-License-Identifier: Apache-2.0
# Everything below does its own set-up: see tools/setup.sh.

.DEFAULT_GOAL := help
.PHONY: help setup demo demo-video demo-slam demo-grasp demo-planning demo-policy cloud-check test test-fast test-kubernetes test-minimum fresh lint bench soak pictures deb docs interfaces clean

## demo   a launch file puts a talker on a container machine and takes it down again
demo:
	@tools/setup.sh demo
	@tools/run.sh best -- python tools/demo.py

## demo-video   the figures of a short run of H.264 and other transports over a slow link
demo-video:
	@tools/setup.sh bench
	@tools/run.sh best -- python benchmarks/streaming.py --short

## demo-slam demo-grasp demo-planning   an application on a container machine, and its picture
demo-slam demo-grasp demo-planning: demo-%:
	@tools/setup.sh bench
	@tools/run.sh best -- ros2 launch fogros2_examples $*.launch.py picture:=$(CURDIR)/.cache/$*.png

## demo-policy   a policy trained by imitation, on a slowed-down robot and on a container machine
demo-policy: launch := tools/run.sh best -- ros2 launch fogros2_examples policy.launch.py \
	policy:=$(CURDIR)/.cache/policy.onnx runs:=$(CURDIR)/.cache/policy.jsonl
demo-policy:
	@tools/setup.sh bench
	@OPENBLAS_NUM_THREADS=1 tools/run.sh best -- python -m fogros2_examples.policy.training .cache/policy.onnx
	@rm -f .cache/policy.jsonl
	@$(launch) machine:=robot slowdown:=23.3
	@$(launch) machine:=container picture:=$(CURDIR)/.cache/policy.png

## cloud-check   PROVIDER=aws|azure|gcp|kubernetes: the talker on the smallest machine there
cloud-check:
	@tools/setup.sh cloud
	@tools/run.sh best -- python tools/cloud_check.py $(PROVIDER) $(if $(OPTIONS),--options '$(OPTIONS)')

## test   all tests but those with a cluster, on ROS 2's wheels and, where it is installed, on ROS 2
test:
	@tools/setup.sh test
	@tools/test.sh $(ARGS)

## test-fast   the tests that make no machine, on ROS 2's wheels, in less than 90 s
test-fast:
	@tools/setup.sh test
	@rm -f .cache/test-*.xml
	@tools/run.sh embedded -- pytest -n 3 --dist loadgroup --no-loadscope-reorder \
		--junit-xml=.cache/test-fast.xml test/unit test/contract test/launch $(ARGS)

## fresh   the commands above on newly installed systems; results go to benchmarks/results/fresh.md
fresh:
	@tools/fresh.py $(ARGS)

## test-kubernetes   the tests with a real Kubernetes cluster, built first if it isn't there
test-kubernetes:
	@tools/setup.sh test
	@tools/kubernetes.sh >/dev/null
	@tools/test.sh kubernetes $(ARGS)

## test-minimum   the tests without machines, with the oldest versions that are supported
test-minimum: export FOGROS2_VENV = $(CURDIR)/.venv-minimum
test-minimum:
	@PIP_CONSTRAINT=$(CURDIR)/packaging/noble.txt tools/setup.sh lint
	@tools/run.sh embedded -- pytest test/unit test/contract test/launch ros2_embedded/test $(ARGS)

## lint   ruff, mypy, and a check for phrases and names of tests that are hard to read
lint:
	@tools/setup.sh lint
	@tools/lint.sh

## bench  every benchmark; figures go to benchmarks/results
bench:
	@tools/setup.sh bench
	@set -e; for script in $(filter-out benchmarks/chaos.py benchmarks/security.py benchmarks/theora.py benchmarks/ordinary.py benchmarks/applications_%,$(wildcard benchmarks/*.py)); do \
		echo "== $$script"; tools/run.sh best -- python "$$script"; done

## pictures  tables and plots of the stored figures, and the pictures of the pages, anew
pictures:
	@tools/setup.sh test
	@cd benchmarks && ../tools/run.sh embedded -- python -m figures
	@tools/run.sh embedded -- python -m rigs.pictures

## docs   the documentation, as pages for a browser
docs:
	@tools/setup.sh docs
	@tools/run.sh embedded -- python tools/docs.py

## deb    the Debian package, for Ubuntu 24.04 with ROS 2 Jazzy
deb:
	@tools/setup.sh lint
	@tools/run.sh embedded -- python packaging/deb.py

## soak   the long tests and figures that 'make test' and 'make bench' leave out
soak:
	@tools/setup.sh bench
	@tools/run.sh embedded -- pytest -m soak $(ARGS)
	@tools/run.sh embedded -- python benchmarks/security.py
	@tools/run.sh embedded -- python benchmarks/chaos.py
	@tools/run.sh embedded -- python benchmarks/chaos.py --defaults

## setup  only what the others need: system packages and the virtual environment
setup:
	@tools/setup.sh demo

## interfaces  what builds a workspace's own messages beside ROS 2's wheels
interfaces:
	@tools/setup.sh interfaces

## clean  take away what the targets above made in this folder
clean:
	rm -rf .venv .venv-ros .venv-minimum .cache build install log *.egg-info ros2_embedded/*.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

help:
	@echo 'make demo and make test are where to begin. All targets:'
	@sed -n 's/^## /  make /p' Makefile
