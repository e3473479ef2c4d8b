# make demo    set everything up and reconstruct the demo scene
# make test    set everything up and run all checks and tests
# make setup   make the environment in .venv alone

PYTHON ?= python3
BIN := .venv/bin
export PATH := $(CURDIR)/.venv/bin:$(PATH)

.PHONY: setup demo test check clean

setup: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,slurm,kubernetes]'
	touch $@

demo: setup
	$(BIN)/python -m snakesfm.synthetic.render_demo demo
	$(BIN)/snakemake --profile profiles/local --config images=demo/images reference=demo/reference output=results

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/snakefmt --check Snakefile workflow
	$(BIN)/mypy
	$(BIN)/python -m snakesfm.synthetic.render_demo demo
	$(BIN)/snakemake --lint
	$(BIN)/snakemake --profile profiles/local --quiet --dry-run --config images=demo/images output=results

test: check
	$(BIN)/python -m pytest

clean:
	rm -rf .venv results demo .snakemake
