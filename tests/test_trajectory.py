"""The motion along a path, the deviation from it, and the evidence for a motion term."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from paceline.cameras import Camera, StereoRig
from paceline.speed.configuration import DEFAULTS, DriverSettings
from paceline.speed.geometry.fitted_arc import fit_arc
from paceline.speed.geometry.initial_plane import InitialPlane
from paceline.speed.geometry.paths import from_points, resampled
from paceline.speed.refinement import path_deviation
from paceline.speed.refinement.path_deviation import PathDeviation, deviation_from_arc, deviation_modes
from paceline.speed.refinement.photometric_fit import PhotometricFit
from paceline.speed.refinement.trajectory import (
    MOTION_PARAMETER_NAMES,
    MOTION_TERMS,
    PARAMETER_INDEX,
    Prior,
    Trajectory,
    exact_timing,
    prior,
)
from paceline.speed.refinement.trajectory_cpu import own_path_frames

K = np.array([[2000.0, 0, 511.5], [0, 2000.0, 383.5], [0, 0, 1]])
RIG = StereoRig(Camera((1024, 768), K), Camera((1024, 768), K), np.eye(3), np.array([-0.5, 0, 0]))
QUAD = np.array([[480.0, 400.0], [540.0, 401.0], [541.0, 425.0], [481.0, 424.0]])


def straight_path():
    return from_points("lane", "line", np.array([[0.5, 1.5, 10.0], [1.5, 1.4, 40.0], [2.5, 1.3, 70.0]]))


def curved_path(radius=120.0):
    turn = np.linspace(0.0, 0.6, 60)
    points = np.column_stack([radius * (1 - np.cos(turn)), np.full(60, 1.5), 10 + radius * np.sin(turn)])
    sideways = 0.05 * np.sin(np.linspace(0, 5, 60))[:, None] * np.array([1.0, 0.0, 0.2])
    return resampled("lane", "curve", points, sideways[None])


def trajectory_on(path, times=(0.0, 0.2, 0.4, 0.8)):
    ray = RIG.left.rays(QUAD.mean(0))
    plane = InitialPlane(
        centre=30.0 * ray,
        normal=np.array([0.0, 0.0, 1.0]),
        distance=30.0,
        normal_std=np.array([0.05, 0.05]),
        inverse_depth_std=0.01,
    )
    deviation = deviation_modes(path, path.nearest(plane.centre), 20.0, on_path=True)
    exact = exact_timing(len(times))
    return Trajectory(
        RIG, QUAD, plane, path, np.stack([times, times], axis=1), deviation, np.array(times), exact, np.zeros(2)
    )


def start_of(t, depth=30.0, speed=15.0):
    theta = np.zeros(len(t.steps))
    theta[[PARAMETER_INDEX["log_depth"], PARAMETER_INDEX["speed"]]] = np.log(depth), speed
    return theta


@pytest.mark.parametrize("acceleration", [0.0, -2.0])
def test_on_a_straight_path_the_plane_moves_straight(acceleration):
    t = trajectory_on(straight_path())
    theta = start_of(t)
    theta[PARAMETER_INDEX["acceleration"]] = acceleration
    forward = np.diff(t.path.at(np.array([0.0, 1.0])), axis=0)[0]
    distance = 15.0 * t.times[:, 0] + 0.5 * acceleration * t.times[:, 0] ** 2
    expected = 30.0 * RIG.left.rays(QUAD.mean(0)) + distance[:, None] * forward
    np.testing.assert_allclose(t.centres(theta), expected, atol=1e-6)


def test_on_a_curve_the_distance_is_speed_times_time():
    t = trajectory_on(curved_path(), times=np.linspace(0, 1.5, 200))
    theta = start_of(t)
    count = len(t.deviation.modes)
    theta[len(MOTION_PARAMETER_NAMES) :][:count] = np.random.default_rng(2).normal(0, 0.5, count)
    length = np.linalg.norm(np.diff(t.centres(theta), axis=0), axis=1).sum()
    assert length == pytest.approx(15.0 * 1.5, rel=1e-4)


@pytest.mark.parametrize("yaw", [-0.7, 0.0, 0.5])
def test_the_middle_of_outlines_is_that_of_the_face(yaw):
    """Of a rectangle that is seen obliquely: the mean of its corners in the image is not its centre."""
    t = trajectory_on(straight_path())
    theta = start_of(t, depth=20.0)
    theta[PARAMETER_INDEX["normal_yaw"]] = yaw
    _, _, normal, distance = t.motion(theta)
    across = np.cross([0.0, 1.0, 0.0], normal)
    across *= np.sign(across[0]) / np.linalg.norm(across)
    down = np.cross(normal, across)
    centre = distance / normal[2] * np.array([0.0, 0.0, 1.0])
    corners = centre + np.array([[-0.9, -0.3], [0.9, -0.3], [0.9, 0.3], [-0.9, 0.3]]) @ [across, down]
    left, right = RIG.project(corners)
    t = replace(t, quad=left)
    theta[PARAMETER_INDEX["log_depth"]] = np.log(distance / (normal @ RIG.left.rays(left.mean(0))))
    from_centre = float((centre - t.centres(theta)[0]) @ across) / 1.8
    assert t.middle_of_outlines(theta, right) == pytest.approx(from_centre, abs=1e-3)
    assert abs(from_centre) > 0.005 or yaw == 0.0
    aside = t.middle_of_outlines(theta, right + np.array([0.18 * 2000 / centre[2], 0.0]))
    assert aside - from_centre == pytest.approx(0.05 / np.cos(yaw), abs=0.02)  # half of 0.1 widths


def test_distance_is_the_integral_of_the_speed():
    t = trajectory_on(straight_path(), times=tuple(np.linspace(0.0, 1.2, 1201)))
    rng = np.random.default_rng(3)
    theta = start_of(t)
    theta[PARAMETER_INDEX["acceleration"]] = -1.5
    theta[t.index("varying_acceleration")] = rng.normal(0.0, 1.0, len(t.index("varying_acceleration")))
    v, seconds = t.speed_jacobian @ theta, t.times[:, 0]
    expected = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(seconds))])
    np.testing.assert_allclose(t.distance(theta)[:, 0], expected, atol=1e-5)
    assert t.mean_speed_gradient @ theta == pytest.approx(expected[-1] / 1.2, abs=1e-5)
    assert v[0] == pytest.approx(15.0) and np.ptp(np.diff(v)) > 1e-4  # it does change its acceleration


def test_accelerations_are_second_differences_of_the_places():
    t = trajectory_on(curved_path(), times=tuple(np.linspace(0.0, 1.2, 13)))
    theta = start_of(t)
    theta[PARAMETER_INDEX["acceleration"]], theta[PARAMETER_INDEX["curvature"]] = -2.5, 1 / 60
    dense = trajectory_on(curved_path(), times=tuple(np.linspace(0.0, 1.2, 1201)))
    velocity = np.diff(dense.centres(theta), axis=0) / 0.001
    acceleration = np.diff(velocity, axis=0)[49::100] / 0.001  # midway between the frames
    direction = velocity[49::100] / np.linalg.norm(velocity[49::100], axis=1)[:, None]
    along = (acceleration * direction).sum(1)
    across = np.linalg.norm(acceleration - along[:, None] * direction, axis=1)
    np.testing.assert_allclose(t.accelerations(theta), np.column_stack([along, across]), atol=0.05)


@pytest.mark.parametrize("driver", [DriverSettings(), DriverSettings(braking=5.0, braking_time=0.8)])
def test_varying_accelerations_have_the_stated_covariance(driver):
    """Accelerations drawn from the prior have the stated deviation, and the stated correlation over time."""
    t = replace(trajectory_on(straight_path(), times=tuple(np.linspace(0.0, 2.0, 401))), driver=driver)
    sigma, scale = t.driver.braking, t.driver.braking_time
    a = np.gradient(t.speed_jacobian[:, t.index("varying_acceleration")], t.times[:, 0], axis=0)[1:-1]
    kernel, seconds = a @ a.T, t.times[1:-1, 0]
    expected = sigma**2 * np.exp(-0.5 * ((seconds[:, None] - seconds) / scale) ** 2)
    np.testing.assert_allclose(kernel, expected, atol=0.02 * sigma**2)


@pytest.mark.parametrize("path", [straight_path(), curved_path()])
def test_a_batch_of_motions_equals_single_ones(path):
    t = trajectory_on(path)
    rng = np.random.default_rng(5)
    thetas = start_of(t) + rng.normal(0, 30, (3, 2, len(t.steps))) * t.steps
    R, shift, n, d = t.motion(thetas)
    H, per_metre = t.homographies(thetas)
    for i in np.ndindex(3, 2):
        # the splines have other knots: the difference is far below a pixel
        for many, one in zip((R[i], shift[i], n[i], d[i]), t.motion(thetas[i]), strict=True):
            np.testing.assert_allclose(many, one, atol=1e-6)
        np.testing.assert_allclose(t.quads(thetas)[i], t.quads(thetas[i]), atol=1e-4)
        np.testing.assert_allclose(per_metre[i], t.homographies(thetas[i])[1], rtol=1e-4, atol=1e-4)
    assert H.shape == (3, 2, len(t.times), 2, 3, 3)


@pytest.mark.parametrize("radius", [25.0, 120.0])
def test_without_deviation_the_own_path_is_the_drawn_one(radius):
    """The compiled integration against the path's own splines, frames and nearest place, beyond its ends as well."""
    path = curved_path(radius)
    beside = path.at(np.array([path.s[-1] - 8.0])) + np.array([[0.4, -0.2, 0.1]])
    start, distances = path.nearest(beside[0]), np.linspace(-4.0, 12.0, 13)
    frames, places = np.empty((1, 13, 3, 3)), np.empty((1, 13, 3))
    u, none = np.linspace(-5.0, 13.0, 97), np.zeros((1, 97))
    own_path_frames(*path.pieces(), beside, u, none, none, distances[None], frames, places)
    # the curvature jumps at the path's end
    np.testing.assert_allclose(frames[0], path.frames(start + distances), atol=2e-4)
    np.testing.assert_allclose(frames[0, :7], path.frames(start + distances[:7]), atol=1e-6)
    expected = path.at(start + distances)
    np.testing.assert_allclose(places[0] - places[0, 0], expected - expected[0], atol=1e-4)


def test_homographies_equal_projected_points():
    """Points of the initial plane, and of one 5 cm off it, moved rigidly and projected into both views, against H and
    ∂H/∂d."""
    t = trajectory_on(curved_path())
    theta = start_of(t)
    theta[PARAMETER_INDEX["normal_yaw"]], theta[PARAMETER_INDEX["curvature"]] = 0.05, 0.004
    R, shift, n, d = t.motion(theta)
    H, per_metre = t.homographies(theta)
    rng = np.random.default_rng(3)
    for u, v in rng.uniform(0, 1, (5, 2)):
        first = H[0, 0] @ [u, v, 1.0]
        ray = RIG.left.rays(first[:2] / first[2])
        for off in (0.0, 0.05):
            point = ray * (d + off) / (n @ ray)
            for frame in range(len(t.times)):
                for view in (0, 1):
                    expected = RIG.project(R[frame, view] @ point + shift[frame, view])[view]
                    seen = (H + off * per_metre)[frame, view] @ [u, v, 1.0]
                    np.testing.assert_allclose(seen[:2] / seen[2], expected, atol=1e-6)


def test_the_deviation_has_the_covariance_of_its_parts():
    """That of the reconstruction, the polynomial driver prior and lane keeping, but for negligible modes."""
    path = curved_path()
    deviation = deviation_modes(path, 5.0, 40.0, on_path=True)
    count = len(deviation.modes) - deviation.lane_change_modes
    lane_keeping = deviation.modes[:count].reshape(-1, 2 * len(deviation.u))
    yaw, pitch = path.heading_modes(5.0 + deviation.u)
    sigma, length = path_deviation.LANE_KEEPING_GP
    expected = np.zeros((2 * len(deviation.u),) * 2)
    u, powers = deviation.u, (1.0, 1.0, 2.0, 6.0)
    n = len(u)
    expected[:n, :n] = sigma**2 * np.exp(-0.5 * ((u[:, None] - u) / length) ** 2) + yaw.T @ yaw
    expected[n:, n:] = pitch.T @ pitch
    expected[:n, n:] = yaw.T @ pitch
    expected[n:, :n] = expected[:n, n:].T
    stds = path_deviation.direction_prior(DEFAULTS.driver)
    for half, name in ((slice(0, n), "yaw"), (slice(n, 2 * n), "pitch")):
        for k, s in enumerate(stds[name]):
            term = s * u**k / powers[k]
            expected[half, half] += np.outer(term, term)
    variance = np.diag(expected)
    np.testing.assert_allclose(np.diag(lane_keeping.T @ lane_keeping), variance, atol=0.02 * variance.max())


def test_the_expected_driver_is_the_prior():
    path = straight_path()
    usual = DriverSettings()
    other = DriverSettings(
        steadiness=0.05, braking=5.0, heading=0.05, pitch=0.02, lane_change=0.3, lane_change_length=20.0
    )
    deviations = [deviation_modes(path, 5.0, 40.0, on_path=True, driver=driver) for driver in (usual, other)]
    kept = [d.modes[: len(d.modes) - d.lane_change_modes] for d in deviations]
    at = np.argmin(np.abs(deviations[0].u))  # there the direction alone counts, and the reconstruction in both
    gained = [np.square(modes[:, :, at]).sum(0) for modes in kept]
    wanted = [0.05**2 - usual.heading**2, 0.02**2 - usual.pitch**2]
    np.testing.assert_allclose(gained[1] - gained[0], wanted, rtol=0.02)
    change = deviations[1].modes[-deviations[1].lane_change_modes :, 0]
    u, wide = deviations[1].u, 0.3**2
    np.testing.assert_allclose(
        change.T @ change, wide * np.exp(-0.5 * ((u[:, None] - u) / 20.0) ** 2), atol=0.02 * wide
    )
    t = replace(trajectory_on(path), driver=other)
    i = PARAMETER_INDEX["acceleration"]
    for terms, std in (((), 0.05), (("acceleration",), 5.0)):
        p = prior(t, 15.0, terms)
        assert p.information[list(p.free).index(i), list(p.free).index(i)] == pytest.approx(std**-2)


def test_angles_are_the_modes_and_constant_beyond_them():
    u = np.linspace(0, 10, 21)
    modes = np.stack([np.stack([np.sin(u), 0 * u]), np.stack([0 * u, u / 10])])
    deviation = PathDeviation(u, modes, lane_change_modes=0, mean=np.zeros(2))
    yaw, pitch = deviation.angles(np.array([2.0, 3.0]), np.array([-5.0, 0.0, 2.5, 10.0, 99.0]))
    np.testing.assert_allclose(yaw, 2 * np.sin([0, 0, 2.5, 10, 10]), atol=1e-12)
    np.testing.assert_allclose(pitch, [0, 0, 0.75, 3, 3], atol=1e-12)


def test_motion_terms_are_free_only_where_they_are_named():
    t = trajectory_on(curved_path())
    plain = prior(t, 15.0)
    assert not set(t.index("lane_change")) & set(plain.free) and PARAMETER_INDEX["curvature"] not in plain.free
    i = list(plain.free).index(PARAMETER_INDEX["acceleration"])  # steady drivers
    assert plain.information[i, i] == pytest.approx(t.driver.steadiness**-2)
    places = [set(t.index(term)) for term in MOTION_TERMS]
    assert sum(map(len, places)) == len(set().union(*places))
    for term, there in zip(MOTION_TERMS, places, strict=True):
        assert there <= set(prior(t, 15.0, (term,)).free) and (term == "acceleration" or not there & set(plain.free))


@pytest.mark.parametrize("held", [0.15, None])
@pytest.mark.parametrize(("value", "spread"), [(0.1, 0.5), (1.2, 0.3), (0.02, 0.01)])
def test_the_evidence_is_the_ratio_of_marginal_likelihoods(value, spread, held):
    """Against numerical integration over one parameter, measured as ``value`` ± ``spread`` by the images alone."""
    wide = 2.0
    information = spread**-2 + wide**-2
    posterior = value * spread**-2 / information
    fit = SimpleNamespace(
        trajectory=SimpleNamespace(index=lambda _: np.array([0])),
        prior=Prior(np.zeros(1), np.array([0]), np.array([[wide**-2]])),
        theta=np.array([posterior]),
        A=np.array([[information]]),
    )
    free = np.array([0]) if held else np.array([], np.int64)
    narrower = Prior(np.zeros(1), free, np.eye(len(free)) * (held or 1.0) ** -2)

    def marginal(sigma):
        reach = 8 * min(sigma, spread)
        middle = value * sigma**2 / (sigma**2 + spread**2)
        return quad(lambda a: norm.pdf(value, a, spread) * norm.pdf(a, 0, sigma), middle - reach, middle + reach)[0]

    under_narrow = marginal(held) if held else norm.pdf(value, 0, spread)
    expected = np.log(marginal(wide) / under_narrow)
    found = PhotometricFit._log_evidence(fit, "acceleration", narrower, 1.0)
    assert found == pytest.approx(expected, abs=2e-3)


def arc_beside(path, turned_by):
    """An arc through places beside ``path`` whose direction is ``turned_by`` rad to the left of the path's."""
    about, places = path.at(np.array(5.0)), path.at(np.linspace(5.0, 35.0, 12))
    cos, sin = np.cos(turned_by), np.sin(turned_by)
    turn = np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])
    return fit_arc("v0", (places - about) @ turn.T + about)[0]


def test_a_drawn_path_is_the_prior_of_the_arcs_direction():
    path = curved_path()
    arc = arc_beside(path, 0.02)
    deviation = deviation_from_arc(arc, arc.nearest(path.at(np.array(5.0))), 30.0, path)
    yaw = deviation.angles(deviation.mean, np.array([15.0]))[0]
    assert yaw == pytest.approx(0.02, abs=0.004)


def test_a_drawn_path_is_no_evidence_beyond_its_ends():
    """The vehicle drives on along the same bend where the drawing, which runs on straight in the model, has ended."""
    path = curved_path(60.0)
    arc = arc_beside(path, 0.0)
    half = len(path.s) // 2
    ended = replace(path, s=path.s[:half], points=path.points[:half], modes=path.modes[:, :half])
    deviation = deviation_from_arc(arc, arc.nearest(path.at(np.array(5.0))), 28.0, ended)
    u = np.linspace(0.0, 28.0, 5)
    assert path.s[half] < 20.0
    np.testing.assert_allclose(deviation.angles(deviation.mean, u), 0.0, atol=0.01)


def test_a_path_that_begins_beyond_the_track_tells_nothing_of_it():
    path = curved_path()
    arc, _ = fit_arc("v0", path.at(np.linspace(-40.0, -20.0, 9)))
    deviation = deviation_from_arc(arc, 0.0, 15.0, path)
    unseen = deviation_from_arc(arc, 0.0, 15.0, replace(path, modes=100.0 * path.modes))
    np.testing.assert_allclose(deviation.modes, unseen.modes, atol=1e-9)


@pytest.mark.parametrize("modes", [1.0, 30.0])
def test_how_well_the_path_is_known_is_how_well_the_arc_is(modes):
    """Against the joint Gaussian of coefficients and path, conditioned on the path's angles by its covariance form."""
    path = curved_path()
    path = replace(path, modes=modes * path.modes)
    arc = arc_beside(path, 0.01)
    start = arc.nearest(path.at(np.array(5.0)))
    deviation = deviation_from_arc(arc, start, 30.0, path)
    count = len(deviation.modes) - deviation.lane_change_modes
    posterior = np.einsum("kan,kbm->anbm", deviation.modes[:count], deviation.modes[:count])
    u = deviation.u
    of_path = deviation_modes(path, path.nearest(arc.at(np.array(start))), 30.0, on_path=True)
    H = of_path.modes[: len(of_path.modes) - of_path.lane_change_modes].reshape(-1, 2 * len(u))
    C = H.T @ H + path_deviation.ARC_MISFIT_STD_RAD**2 * np.eye(2 * len(u))
    yaw_stds, (pitch_std,) = path_deviation.TURN_PRIOR["yaw"], path_deviation.TURN_PRIOR["pitch"]
    zero = np.zeros_like(u)
    B = [[yaw_stds[0] + zero, zero], [yaw_stds[1] * u, zero], [zero, pitch_std + zero]]
    B = np.concatenate([B, np.stack(arc.heading_modes(start + u), axis=1)]).reshape(-1, 2 * len(u))
    prior_covariance = B.T @ B
    expected = prior_covariance - prior_covariance @ np.linalg.solve(prior_covariance + C, prior_covariance)
    np.testing.assert_allclose(posterior.reshape(2 * len(u), -1), expected, atol=1e-7)
