# Two commands do everything on a fresh clone: `make track` and `make test`.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready

.PHONY: track test test-slow test-browser lint docs figures charts benchmarks mutants clean

track: $(READY)  ## follow the figure of eight in closed loop; pictures and table in results/lemniscate
	$(BIN)/pcr-mpc track models/scenes/lemniscate.toml

test: $(READY)  ## the default test run
	$(BIN)/python -m pytest -q -n auto --dist loadfile

test-slow: $(READY)  ## the tests marked slow, but for those of minutes: -m longest
	$(BIN)/python -m pytest -q -m "slow and not longest" -n auto --dist loadfile

test-browser: $(READY)  ## the page of `pcr-mpc view` in a headless browser; screenshots in results/browser
	.ci/browser
	$(BIN)/python -m pytest -q -s tests/browser

lint: $(READY)  ## style, types, layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(READY)  ## the pages, in docs/_build/html; warnings are errors, and figures in the text must be those of the records
	$(BIN)/python -m experiments.upkeep.text_figures
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html

figures: $(READY)  ## the paper's figures and the README's pictures, in docs/figures/
	$(BIN)/python -m experiments.statics.paper_figures --out docs/figures
	$(BIN)/python -m experiments.statics.finite_differences --out docs/figures
	$(BIN)/python -m experiments.statics.equilibria --out docs/figures
	$(BIN)/python -m experiments.motion.time_step_limits --out docs/figures
	$(BIN)/python -m experiments.statics.snap --out docs/figures
	$(BIN)/python -m experiments.motion.rod_inertia --out docs/figures
	$(BIN)/python -m experiments.motion.mujoco_agreement --out docs/figures
	$(BIN)/python -m experiments.speed.growth --out docs/figures
	$(BIN)/python -m experiments.control.path_kinds --out docs/figures
	$(BIN)/python -m experiments.control.rungs --out docs/figures
	$(BIN)/python -m experiments.statics.workspace --out results/workspace
	cp results/workspace/*.png docs/figures/
	$(BIN)/python -m experiments.statics.basins --seeds 3 --out results/basins
	cp results/basins/*.png docs/figures/
	$(BIN)/python -m experiments.control.linear_validity --out docs/figures
	$(BIN)/python -m experiments.control.monte_carlo --episodes 500 --out results/monte_carlo/figure
	cp results/monte_carlo/figure/monte_carlo.png docs/figures/
	$(BIN)/python -m experiments.control.fold_guard --out results/fold_guard
	$(BIN)/python -m experiments.control.controllers --out results/controllers
	cp results/fold_guard/*.png results/controllers/*.png docs/figures/
	$(BIN)/pcr-mpc track models/scenes/lemniscate.toml --out results/lemniscate
	cp results/lemniscate/track.png results/lemniscate/track.gif results/lemniscate/replay.html docs/figures/
	$(BIN)/pcr-mpc timing models/scenes/lemniscate.toml --out results/timing
	cp results/timing/timing.png docs/figures/
	$(BIN)/python -m experiments.control.loop_stability --out results/loop_stability
	cp results/loop_stability/delay_stiffness.png docs/figures/loop_stability.png
	cp results/loop_stability/delay_period.png docs/figures/loop_stability_period.png
	cp results/loop_stability/lag_horizon.png docs/figures/loop_stability_lag.png
	$(BIN)/python -m experiments.control.learning --out results/learning
	cp results/learning/learning.png docs/figures/
	$(BIN)/pcr-mpc plan eight_points --out results/plan/eight_points.csv
	cp results/plan/eight_points.png docs/figures/planning.png
	$(MAKE) test-browser
	cp results/browser/drag.png docs/figures/view.png

charts: $(READY)  ## speed against accuracy: three charts, their CSVs and the ratios, in docs/figures/; wants an idle machine
	$(BIN)/python -m experiments.speed.accuracy_vs_speed --out results/charts
	cp results/charts/accuracy_vs_speed_* docs/figures/

benchmarks: $(READY)  ## ratios of ours to fixed references against those kept in docs/records/benchmarks.json
	$(BIN)/python -m experiments.speed.benchmarks

N ?= 200
mutants: $(READY)  ## which of N changes of the code the tests notice, in results/mutants; hours
	$(BIN)/python -m experiments.upkeep.mutants --count $(N)

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev,docs,peers,cluster,tune,mujoco,view,browser,fmu]"
	touch $(READY)

clean:
	rm -rf .venv results docs/_build docs/generated
