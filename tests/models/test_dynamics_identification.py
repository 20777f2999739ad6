"""Identification on synthetic responses whose parameters are known."""

import numpy as np
import pytest

from models.dynamics.assembly import CondensedAssembly, SpindleAssembly
from models.dynamics.beam import Segment
from models.dynamics.bearings import CondensedShaft, inverse_rows, properties_from_parameters
from models.dynamics.chain import Chain, SpringDamper, Support
from models.dynamics.contact import Interface, chain_receptance, identify_contact
from models.dynamics.identification import FIXED, identify_bearings
from models.dynamics.measurement import Measurement, MeasurementError, check_for_identification
from models.dynamics.response_fit import good_fit, line_weights
from models.dynamics.section import Elasticity, Tube, beam_segment

STEEL = Elasticity(young_pa=200e9, shear_pa=76.9e9, poisson=0.3, density_kg_per_m3=7850.0)
PLACES = (("12", 0.0991), ("12", 0.1271), ("34", 0.1841), ("34", 0.2111), ("5", 0.4371))
FREQUENCY_HZ = np.linspace(300.0, 2500.0, 500)
TRUE = {"kt_12": 4e7, "ct_12": 2.5e3, "kr_12": 3e6, "cr_12": 2.0, "kt_34": 1.4e8, "ct_34": 900.0, "kr_34": 2e5,
        "cr_34": 3.0, "kt_5": 6e7, "ct_5": 2e3, "kr_5": 4e5, "cr_5": 5.0}  # fmt: skip


def tube(length_mm: float, outer_mm: float, inner_mm: float = 0.0) -> Segment:
    section = Tube(outer_m=outer_mm / 1e3, inner_m=inner_mm / 1e3, elasticity=STEEL)
    return beam_segment(length_mm / 1e3, (section,), structural_damping=0.003)


@pytest.fixture(scope="module")
def chain() -> Chain:
    supports = tuple(Support(position_m=m, group=group, properties=SpringDamper()) for group, m in PLACES)
    return Chain(
        parts=(tube(89.1, 89, 38), tube(165, 60, 28), tube(154, 90, 32.3), tube(93, 45, 33)), supports=supports
    )


@pytest.fixture(scope="module")
def shaft(chain: Chain) -> CondensedShaft:
    return CondensedShaft(chain, FREQUENCY_HZ)


@pytest.mark.parametrize(("parameters", "method"), [(5, "lm"), (5, "nelder-mead"), (7, "lm")])
def test_identification_is_exact_on_synthetic_data(shaft: CondensedShaft, parameters: int, method: str) -> None:
    true = {**TRUE, **FIXED[parameters]}
    measured = shaft.nose_receptance(properties_from_parameters(true))
    found = identify_bearings(shaft, measured, parameters=parameters, method=method)  # type: ignore[arg-type]
    assert set(found.free) == set(TRUE) - set(FIXED[parameters])
    for name in found.free:
        assert found.values[name] == pytest.approx(true[name], rel=1e-4 if method == "lm" else 1e-3), name
    assert found.cost_m_per_n < 1e-4 * np.sum(np.abs(measured))
    if parameters == 5:
        assert all(found.identifiable.values())
    if (parameters, method) == (5, "lm"):
        assert found.evaluations < 60


def test_five_parameters_survive_noise(shaft: CondensedShaft) -> None:
    true = {**TRUE, **FIXED[5]}
    random = np.random.default_rng(7)
    noise = 1.0 + 0.02 * (random.standard_normal(500) + 1j * random.standard_normal(500))
    found = identify_bearings(shaft, shaft.nose_receptance(properties_from_parameters(true)) * noise)
    for name in found.free:
        assert found.values[name] == pytest.approx(true[name], rel=0.05), name
    assert found.log_error == pytest.approx(0.02 * np.sqrt(2), rel=0.2)


def test_twelve_parameters_fit_but_are_not_all_seen(shaft: CondensedShaft) -> None:
    measured = shaft.nose_receptance(properties_from_parameters(TRUE))
    near = {name: value * 1.1 for name, value in TRUE.items()}
    found = identify_bearings(shaft, measured, parameters=12, start=near)
    assert found.log_error < 0.02
    assert len(found.free) == 12
    assert not all(found.identifiable.values())


def test_a_parameter_without_influence_is_not_identifiable(shaft: CondensedShaft) -> None:
    true = {**TRUE, **FIXED[5], "ct_5": 1e-6}
    found = identify_bearings(shaft, shaft.nose_receptance(properties_from_parameters(true)))
    assert not found.identifiable["ct_5"]
    assert found.identifiable["kt_5"]


@pytest.mark.parametrize("parameters", [5, 7])
def test_no_start_ends_in_a_wrong_set_of_values_that_counts_as_identifiable(
    shaft: CondensedShaft, parameters: int
) -> None:
    random = np.random.default_rng(parameters)
    for noise in (0.0, 0.05):
        for _ in range(4):
            true = {name: value * np.exp(random.uniform(-0.7, 0.7)) for name, value in TRUE.items()}
            true |= FIXED[parameters]
            scatter = noise * (random.standard_normal(500) + 1j * random.standard_normal(500)) / np.sqrt(2.0)
            measured = shaft.nose_receptance(properties_from_parameters(true)) * (1.0 + scatter)
            start = {name: true[name] * np.exp(random.uniform(-3.5, 3.5)) for name in true}
            found = identify_bearings(shaft, measured, parameters=parameters, start=start)
            for name in found.free:
                if found.identifiable[name]:
                    low, high = found.interval[name]
                    assert low <= true[name] <= high, (noise, name)


def test_lines_that_noise_covers_count_less_and_do_not_spoil_the_fit(shaft: CondensedShaft) -> None:
    true = {**TRUE, **FIXED[5]}
    clean = shaft.nose_receptance(properties_from_parameters(true))
    random = np.random.default_rng(5)
    scatter = random.standard_normal(500) + 1j * random.standard_normal(500)
    assert line_weights(clean) == pytest.approx(np.ones(500), abs=0.05)
    assert np.ptp(line_weights(clean * (1.0 + 0.05 * scatter))) < 0.8
    measured = clean + 0.03 * np.sqrt(np.mean(np.abs(clean) ** 2)) * scatter
    weight = line_weights(measured)
    quiet = np.abs(clean) > np.percentile(np.abs(clean), 80)
    assert weight[quiet].mean() > 3.0 * weight[np.abs(clean) < np.percentile(np.abs(clean), 20)].mean()
    found = identify_bearings(shaft, measured)
    for name in found.free:
        assert found.values[name] == pytest.approx(true[name], rel=0.15), name


@pytest.mark.parametrize("method", ["lm", "nelder-mead"])
def test_contact_parameters_are_found_again(chain: Chain, method: str) -> None:
    properties = properties_from_parameters({**TRUE, **FIXED[5]})
    joint = SpringDamper(kt_n_per_m=1.25e8, ct_ns_per_m=3.56e3, kr_nm_per_rad=8.63e5, cr_nms_per_rad=2.35e3)
    holder = (tube(25, 42, 20), tube(53, 48, 20), tube(26, 63, 20))
    whole = CondensedAssembly(SpindleAssembly(shaft=chain, front=(*holder, joint)), FREQUENCY_HZ)
    measured = whole.receptance(properties)
    rows = inverse_rows(CondensedShaft(chain, FREQUENCY_HZ).nose_stiffness(properties))
    rear = np.stack([rows[0], rows[1], rows[1], rows[2]], axis=1).reshape(-1, 2, 2)
    interface = Interface(
        frequency_hz=FREQUENCY_HZ, front=chain_receptance(Chain(parts=holder), FREQUENCY_HZ), rear=rear
    )
    true = {"kt": 1.25e8, "ct": 3.56e3, "kr": 8.63e5, "cr": 2.35e3}
    computed, slopes = interface.response(true)
    assert computed == pytest.approx(measured, rel=1e-7)
    for name, value in true.items():
        step = {**true, name: value * 1.00001}
        slope = (interface.response(step)[0] - computed) / (value * 1e-5)
        assert slopes[name] == pytest.approx(slope, rel=1e-3, abs=1e-4 * abs(slope).max()), name
    found = identify_contact(interface, measured, method=method)
    assert found.values == pytest.approx(true, rel=1e-4)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03, 0.08])
def test_a_fit_as_good_as_the_noise_is_good(noise: float) -> None:
    random = np.random.default_rng(5)
    clean = measurement(points=1000).receptance_m_per_n
    scatter = noise * (random.standard_normal(1000) + 1j * random.standard_normal(1000))
    expected = max(0.03, 1.2 * np.sqrt(2.0) * noise)
    assert good_fit(clean * (1.0 + scatter)) == pytest.approx(expected, rel=0.15)


def measurement(size: float = 1e-7, low: float = 300.0, high: float = 2500.0, points: int = 300) -> Measurement:
    at = np.linspace(low, high, points)
    return Measurement(frequency_hz=at, receptance_m_per_n=size / (1 - (at / 1000) ** 2 + 0.05j))


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (measurement(size=0.1), "is the unit um/N"),
        (measurement(low=1200.0, high=1260.0), "from 1200 to 1260 Hz is too narrow"),
        (measurement(low=1200.0, high=2000.0), "holds no resonance"),
        (measurement(size=-1e-7), "the imaginary part is positive"),
        (measurement(points=12), "12 frequencies cannot determine 5"),
    ],
    ids=["unit", "narrow", "no peak", "sign", "few"],
)
def test_unfit_measurements_are_refused(bad: Measurement, words: str) -> None:
    with pytest.raises(MeasurementError, match=words):
        check_for_identification(bad, 5)
    check_for_identification(measurement(), 12)
