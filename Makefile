# Short cuts for contributors; nothing needs make.
.PHONY: setup test slow check build
PY ?= .venv/bin/python

setup:
	python3 -m venv .venv && .venv/bin/pip install -q -e ".[dev]"
test:
	$(PY) -m pytest
slow:
	$(PY) -m pytest -m slow
check:
	.venv/bin/ruff check . && .venv/bin/ruff format --check . && .venv/bin/mypy && .venv/bin/lint-imports
build:
	$(PY) -m build
