"""CBSI: exact recovery from exact realizations, whatever their basis, and its place in JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from band_limited import SEVEN, THREE, chain, error, minimal, state_space
from scipy import signal

from jaxsid.checks import InputError
from jaxsid.physical.cbsi import cbsi, visible_states
from jaxsid.records import ContinuousModel, Realization

FREE = ([1.2, 0.9, 0.7], [0, 2500, 2000], [0, 1.2, 1.0])
GROUNDED = ([1.2, 0.9, 0.7], [0, 2500, 2000], [0.4, 1.2, 1.0])
DRIVE = ([0.0053, 0.18], [0, 9365, 0], [0.43, 0.83, 0.48])
ONE3, ONE2 = np.ones((3, 1)), np.ones((2, 1))
FAST = ([1.2, 0.9, 0.5], [3000, 2500, 800], [1.5, 1.2, 60.0])

HELD = {
    "accelerations": (chain(*THREE), 6, {}),
    "mixed, three inputs": (chain(*THREE, driven=(0, 1, 2), kinds="dva"), 6, {}),
    "mixed, one input": (chain(*THREE, driven=(1,), kinds="adv"), 6, {}),
    "displacements": (chain(*THREE, driven=(2,), kinds="ddd"), 6, {}),
    "velocities, two inputs": (chain(*THREE, driven=(2, 0), kinds="vvv"), 6, {}),
    "an overdamped mode": (chain(*FAST), 6, {}),
    "seven bodies": (chain(*SEVEN, kinds="d" * 7), 14, {}),
}
UNHELD = {
    "free, velocities": (chain(*FREE, kinds="vvv"), 5, {"rigid": ONE3, "loose": ONE3}),
    "free, accelerations": (chain(*FREE, kinds="aaa"), 4, {"rigid": ONE3, "loose": ONE3}),
    "free, displacements": (chain(*FREE, kinds="ddd"), 6, {"rigid": ONE3, "loose": ONE3}),
    "damped to ground, velocities": (chain(*GROUNDED, kinds="vvv"), 5, {"rigid": ONE3}),
    "damped to ground, displacements": (chain(*GROUNDED, kinds="ddd"), 6, {"rigid": ONE3}),
    "drive, velocities": (chain(*DRIVE, kinds="vv"), 3, {"rigid": ONE2}),
    "free drive, velocities": (
        chain(*DRIVE[:2], [0, 0.83, 0], kinds="vv"),
        3,
        {"rigid": ONE2, "loose": ONE2},
    ),
}
# The slow pole of dampers to ground is found from accelerations, which hardly show it.
SLOW = {
    "damped to ground, accelerations": (chain(*GROUNDED, kinds="aaa"), 5, {"rigid": ONE3}),
    "drive, accelerations": (chain(*DRIVE, kinds="aa"), 3, {"rigid": ONE2}),
}

# What these show, a case beside them shows too; each compiles for long.
OTHERS = (
    "displacements",
    "velocities, two inputs",
    "an overdamped mode",
    "free, displacements",
    "damped to ground, displacements",
    "drive, velocities",
)


def realized(system, order, seed=0):
    return ContinuousModel(*map(jnp.asarray, minimal(system, np.random.default_rng(seed), order)))


def identify(system, model, **options):
    return cbsi(model, sensors=system.kind_names, collocated=system.driven, **options)


def errors(found, system):
    return [
        error(a, b)[0] for a, b in zip((found.mass, found.damping, found.stiffness), system[:3], strict=True)
    ]


@pytest.mark.parametrize("solution", ["inverse", "symmetric"])
@pytest.mark.parametrize(
    "case", [pytest.param(x, marks=pytest.mark.slow) if x in OTHERS else x for x in (*HELD, *UNHELD, *SLOW)]
)
def test_exact_data_give_exact_matrices_in_any_basis(case, solution):
    system, order, patterns = {**HELD, **UNHELD, **SLOW}[case]
    limit = 1e-8 if case in SLOW else 1e-9
    for seed in range(2):
        found = identify(system, realized(system, order, seed), solution=solution, **patterns)
        assert max(errors(found, system)) < limit
    assert order == visible_states(
        len(system.kinds),
        system.kind_names,
        *(patterns.get(p, ONE3[:, :0]).shape[1] for p in ("rigid", "loose")),
    )


@pytest.mark.parametrize("case", [*HELD, *UNHELD])
def test_diagnostics_of_exact_data_are_zero(case):
    system, order, patterns = {**HELD, **UNHELD}[case]
    found = identify(system, realized(system, order), **patterns)
    assert found.diagnostics is not None
    for name, value in vars(found.diagnostics).items():
        assert abs(float(value)) < 1e-7, name


def test_input_matrix_and_sensors_name_the_places():
    system = chain(*THREE, driven=(2, 0), kinds="dva")
    found = identify(system, realized(system, 6))
    np.testing.assert_array_equal(found.input_matrix, np.eye(3)[:, [2, 0]])
    np.testing.assert_array_equal(found.displacement_sensors, np.diag([1.0, 0, 0]))
    np.testing.assert_array_equal(found.velocity_sensors, np.diag([0, 1.0, 0]))
    np.testing.assert_array_equal(found.acceleration_sensors, np.diag([0, 0, 1.0]))


def test_a_sampled_realization_is_brought_to_continuous_time():
    system, dt = chain(*THREE), 1e-3
    A, B, C, D, _ = signal.cont2discrete(state_space(system), dt)
    found = identify(system, Realization(A, B, C, D, dt))
    assert max(errors(found, system)) < 1e-8


def test_a_mass_symmetric_solution_stays_symmetric_positive_with_noise():
    system = chain(*THREE)
    model = realized(system, 6)
    rng = np.random.default_rng(1)
    noisy = jax.tree.map(lambda x: x * (1 + 1e-3 * rng.standard_normal(x.shape)), model)
    found = identify(system, noisy, solution="symmetric")
    for matrix, limit in ((found.mass, 0.0), (found.damping, -1e-12), (found.stiffness, -1e-12)):
        np.testing.assert_allclose(matrix, matrix.T, rtol=1e-12)
        values = np.linalg.eigvalsh(matrix)
        assert values[0] > limit * values[-1]
    contradictions = identify(system, noisy).diagnostics
    assert contradictions is not None
    assert float(contradictions.damping_asymmetry) > 1e-3


def test_wrong_polarity_of_an_input_shows_as_negative_scales():
    system = chain(*THREE)
    model = realized(system, 6)
    reversed_force = ContinuousModel(model.A, -model.B, model.C, -model.D)
    found = identify(system, reversed_force)
    assert found.diagnostics is not None
    assert float(found.diagnostics.negative_scales) == 3


def test_jit_and_vmap_agree_with_the_plain_call():
    system = chain(*THREE, driven=(0, 2), kinds="dva")
    models = [realized(system, 6, seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *models)
    run = lambda model: identify(system, model)  # noqa: E731
    together, compiled = jax.vmap(run)(stacked), jax.jit(run)(models[0])
    for i, model in enumerate(models):
        for a, b in zip(jax.tree.leaves(run(model)), jax.tree.leaves(together), strict=True):
            np.testing.assert_allclose(a, b[i], rtol=1e-8, atol=1e-9)
    for a, b in zip(jax.tree.leaves(run(models[0])), jax.tree.leaves(compiled), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize(
    ("system", "order", "patterns"), [HELD["mixed, one input"], UNHELD["damped to ground, velocities"]]
)
def test_derivatives_are_those_of_finite_differences(system, order, patterns):
    model = realized(system, order)
    rng = np.random.default_rng(3)
    direction = jax.tree.map(lambda x: jnp.asarray(rng.standard_normal(x.shape)) * jnp.abs(x).mean(), model)
    weights = [jnp.asarray(rng.standard_normal(system.mass.shape)) for _ in range(3)]

    def value(step):
        moved = jax.tree.map(lambda x, d: x + step * d, model, direction)
        found = identify(system, moved, **patterns)
        return sum(
            (w * x).sum() / jnp.linalg.norm(t)
            for w, x, t in zip(weights, (found.mass, found.damping, found.stiffness), system[:3], strict=True)
        )

    slope = jax.grad(value)(0.0)
    h = 1e-7
    assert np.isfinite(slope)
    np.testing.assert_allclose(slope, (value(h) - value(-h)) / (2 * h), rtol=1e-4)
    np.testing.assert_allclose(jax.jvp(value, (0.0,), (1.0,))[1], slope, rtol=1e-6)


@pytest.mark.usefixtures("single_precision")
@pytest.mark.parametrize("case", ["accelerations", "drive, velocities"])
def test_single_precision_works_to_its_own_accuracy(case):
    system, order, patterns = {**HELD, **UNHELD}[case]
    found = identify(system, realized(system, order), **patterns)
    assert found.mass.dtype == jnp.float32
    mass, damping, stiffness = errors(found, system)
    assert max(mass, stiffness) < 1e-2
    assert damping < 0.2


def test_what_does_not_go_together_is_told():
    system = chain(*THREE)
    model = realized(system, 6)
    kinds = system.kind_names
    with pytest.raises(InputError, match=r"order=5"):
        cbsi(model, sensors=("velocity",) * 3, collocated=(0,), rigid=ONE3)
    free = chain(*FREE, kinds="vvv")
    short = realized(free, 5)
    with pytest.raises(InputError, match=r"6 visible states, but the realization has order 5.*rigid-body"):
        identify(free, short)
    with pytest.raises(InputError, match="sensor kind 'strain' is unknown"):
        cbsi(model, sensors=("strain", *kinds[1:]), collocated=(0,))
    with pytest.raises(InputError, match="one sensor at each degree of freedom: 3 outputs but 2"):
        cbsi(model, sensors=kinds[:2], collocated=(0,))
    for wrong in ((), (0, 1), (3,), (-1,)):
        with pytest.raises(InputError, match="`collocated` must name"):
            cbsi(model, sensors=kinds, collocated=wrong)
    with pytest.raises(InputError, match="solution 'best' is unknown"):
        cbsi(model, sensors=kinds, collocated=(0,), solution="best")
    with pytest.raises(InputError, match="`loose` must hold"):
        cbsi(model, sensors=kinds, collocated=(0,), rigid=np.eye(3)[:, :2], loose=ONE3)
    with pytest.raises(InputError, match="all be of one kind"):
        cbsi(model, sensors=("velocity", *kinds[1:]), collocated=(0,), rigid=ONE3)
