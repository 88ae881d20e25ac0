# Each target creates .venv and installs what it needs: a Rust toolchain and Python are enough.
PYTHON ?= python3
BIN := .venv/bin
SOURCES := $(shell find rust python -name '*.rs' -o -name '*.py') Cargo.toml Cargo.lock pyproject.toml

# Share of the seeds or parameter sets of each study that `make test-long` runs.
STUDIES ?= 0.1

# Two processes of tests share two processors: threads of BLAS would wait for each other, and dense algebra take
# five times as long.
test test-long study: export OPENBLAS_NUM_THREADS := 1

.PHONY: demo test test-long study fuzz bench figures docs lint audit build clean

# Scripts: that every name and argument that they use is there.
LOOSELY := --config-file= --check-untyped-defs --explicit-package-bases --ignore-missing-imports \
	--disable-error-code arg-type --disable-error-code operator

demo: $(BIN)/.built-release
	$(BIN)/equipix demo --force

test: $(BIN)/.built-ci
	cargo test --locked
	$(BIN)/python -m pytest -m "not (timing or long or study)" -n 2 --dist worksteal

# What takes seconds each, or must have the machine for itself.
test-long: $(BIN)/.built-ci
	$(BIN)/python -m pytest -m timing
	$(BIN)/python -m pytest -m "(long or study) and not timing" -n 2 --dist worksteal \
		--study-share $(STUDIES)

study: $(BIN)/.built-ci
	$(BIN)/python -m pytest -m study -n 2 --dist worksteal --study-share 1 \
		--study-record=docs/studies.md

# Random files for every reader; FUZZ_INPUTS ends each after so many.
fuzz: export FUZZ_SECONDS ?= 60
fuzz: $(BIN)/.built-ci $(BIN)/.installed-fuzz
	cd fuzz && cargo fmt --check && cargo clippy --locked -- -D warnings
	$(BIN)/python fuzz/run.py

bench: $(BIN)/.built-release $(BIN)/.installed-bench
	$(BIN)/python benches/run.py

figures: $(BIN)/.built-release
	$(BIN)/python docs/figures.py
	$(BIN)/python docs/before_after.py
	$(BIN)/python docs/convergence.py
	$(BIN)/python docs/spectrum.py
	$(BIN)/python docs/estimate.py
	$(BIN)/python docs/joint.py
	$(BIN)/python docs/nuc.py
	$(BIN)/python docs/drift.py
	$(BIN)/python docs/hardware.py
	$(BIN)/python docs/plan.py
	$(BIN)/python docs/scene.py
	$(BIN)/python docs/section3.py
	$(BIN)/python docs/uncertainty.py

docs:
	RUSTDOCFLAGS="-D warnings" cargo doc --locked --no-deps --workspace

lint: $(BIN)/.built-ci docs
	cargo fmt --all --check
	cargo clippy --locked --workspace --all-targets -- -D warnings
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports --no-logo --no-cache
	$(BIN)/mypy
	$(BIN)/python -m mypy.stubtest equipix._native
	for each in benches docs tools; do \
		MYPYPATH=python:$$each $(BIN)/mypy $(LOOSELY) $$each || exit 1; done
	find python/equipix -name '*.py' | xargs $(BIN)/numpydoc lint

audit:
	@if command -v cargo-deny; then cargo deny --locked check; \
	else echo "no cargo-deny: cargo install --locked cargo-deny"; fi
	@if command -v pip-audit; then pip-audit -r requirements-dev.txt -r requirements-bench.txt -r requirements-fuzz.txt; \
	else echo "no pip-audit: pipx install pip-audit"; fi

$(BIN)/.installed: requirements-dev.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-dev.txt
	touch $@

# What the rivals in benches/peers need, and nothing else does.
$(BIN)/.installed-bench: $(BIN)/.installed requirements-bench.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-bench.txt
	touch $@

$(BIN)/.installed-fuzz: $(BIN)/.installed requirements-fuzz.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-fuzz.txt
	touch $@

# Only one build is installed at a time: that of the target asked for.
$(BIN)/.built-%: $(BIN)/.installed $(SOURCES)
	$(BIN)/maturin develop --locked --profile $* --extras asdf,batch,codecs,fits,hdf5,plot,raw,report,watch,xarray,zarr
	rm -f $(BIN)/.built-*
	touch $@

clean:
	rm -rf .venv target
