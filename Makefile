# The two commands: make demo, make test. Everything else is a part of them.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup demo test docs bench bench-check learned lint format colcon-test clean distclean

# Sourced for anything that runs our code: virtual environment, workspace, DDS settings.
ENV := source ros2_ws/env.sh

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{ printf "  make %-12s %s\n", $$1, $$2 }'

setup:  ## system packages, .venv, ROS 2 workspace (reuses what is there)
	@scripts/setup.sh

demo:  ## simulate two surveys, map both through the node graph, find what changed
	@scripts/setup.sh demo
	@$(ENV) && scripts/demo.sh

lint: setup  ## ruff and mypy
	@$(ENV) && scripts/lint.sh

test: setup  ## set-up, lint, every test
	@$(ENV) && status=0; scripts/lint.sh || status=$$?; scripts/test.sh $(PYTEST_ARGS) || status=$$?; \
	if [ $$status -ne 0 ]; then echo "make test: lint or tests failed, see above" >&2; fi; exit $$status

docs: setup  ## the documentation as a site: out/docs/index.html (no network)
	@$(ENV) && NO_MKDOCS_2_WARNING=1 python -m mkdocs build --strict

bench: setup  ## speed and memory beside peers: benchmarks.json, docs/results/benchmarks.md (a quiet machine, 15 minutes)
	@$(ENV) && python tests/benchmarks/bench.py $(BENCH_ARGS)

learned: setup  ## CPU PyTorch for the learned baselines (subiaco train; 0.2 GB)
	@$(ENV) && scripts/learned.sh

bench-check: setup  ## the same into out/bench; fails where a ratio of benchmarks.json worsened by a third
	@$(ENV) && python tests/benchmarks/bench.py --check $(BENCH_ARGS)

COLCON := --base-paths ros2_ws/src --build-base out/colcon/build --install-base out/colcon/install
colcon-test: setup  ## each package built and tested the ROS way, in out/colcon
	@$(ENV) && python -m colcon --log-base out/colcon/log build --symlink-install --packages-skip subiaco_msgs $(COLCON)
	@$(ENV) && python -m colcon --log-base out/colcon/log test --packages-skip subiaco_msgs \
	    --return-code-on-test-failure $(COLCON)

format: setup  ## let ruff rewrite what it can
	@$(ENV) && ruff check --fix && ruff format

clean:  ## results and caches; keeps .venv, the workspace and bags
	rm -rf out .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find src tests scripts -name __pycache__ -prune -exec rm -rf {} +
	rm -f .venv/.bytecode

distclean: clean  ## everything that was installed or built too
	rm -rf .venv ros2_ws/build ros2_ws/install ros2_ws/log
	find src -maxdepth 2 -name '*.egg-info' -prune -exec rm -rf {} +
