"""Laws of keyframes and of tracks: both judge by the past alone, and neither cares how things are listed."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.frontend.association import Associator
from ctmap_gtsam.frontend.keyframes import select_keyframes
from ctmap_gtsam.frontend.observation import Observation, centre_depth, centre_point, observe
from ctmap_gtsam.parameters import Frontend, Keyframes
from sequences import se3
from sequences.types import Detection
from tests.ctmap_gtsam.scenes import CAMERA, classes, depth_of, frame_of, looking, run_of

SETTINGS = Frontend(start_after=3)
CATALOGUE = classes("mug", "banana")
SPOTS = np.array([[0.0, 0.0, 0.0], [0.2, 0.05, 0.0], [-0.2, 0.1, 0.0]])  # on the table, world, metres
SIZE_M = 0.08


def cameras(n, step=0.01):
    """A camera that goes a way around the table."""
    return [looking(yaw=step * k) for k in range(n)]


def box_at(spot, T_world_camera, jitter=0.0):
    """The box of a thing of `SIZE_M` at a spot."""
    point = se3.transform(se3.inverse(T_world_camera), np.asarray(spot)[None])[0]
    size = SIZE_M * CAMERA.fx / point[2]
    u, v = CAMERA.project(point)
    return Detection((u - size / 2 + jitter, v - size / 2, size, size), np.array([0.2, 0.5, 0.3]))


def seen(k, T, spots, jitter=0.0):
    """Keyframe k: the bare table's depth and a box at each spot."""
    boxes = [box_at(spot, T, jitter) for spot in spots]
    depth = depth_of([], T)
    return Observation(k, frame_of(k, T, depth, boxes), depth, ())


def tracks_of(observations, settings=SETTINGS):
    associator = Associator(settings, CATALOGUE)
    for observation in observations:
        associator.step(observation)
    return associator.tracks()


def spots_of(tracks, observations):
    """Where in the world each track's boxes are, as rows of `SPOTS`."""
    out = []
    for track in tracks:
        points = [
            centre_point(observations[k].frame, observations[k].depth, np.array(d.box))
            for k, d in zip(track.keyframes, track.detections, strict=True)
        ]
        nearest = [int(np.argmin(np.linalg.norm(SPOTS - p, axis=-1))) for p in points]
        out.append(nearest)
    return out


@settings(max_examples=10)
@given(st.integers(0, 2**31))
def test_each_thing_is_one_track_though_a_third_of_its_boxes_are_missed(seed):
    rng = np.random.default_rng(seed)
    observations = []
    for k, T in enumerate(cameras(12)):
        there = SPOTS if k < 3 else SPOTS[rng.random(3) > 0.33]
        observations.append(seen(k, T, there, rng.normal()))
    tracks = tracks_of(observations)
    assert len(tracks) == 3
    for spots in spots_of(tracks, observations):
        assert len(set(spots)) == 1
    for track in tracks:
        assert track.started == 2
        assert all(a < b for a, b in pairwise(track.keyframes))
        assert track.at(-1) is None
        assert [track.at(k) for k in track.keyframes] == list(track.detections)


def test_a_false_alarm_starts_no_track_and_takes_no_number_from_others():
    spots = [[SPOTS[0]]] * 4 + [[SPOTS[0], SPOTS[1]]] + [[SPOTS[0]]] * 5
    spots[7] = [SPOTS[0], SPOTS[2]]
    observations = [seen(k, T, s) for k, (T, s) in enumerate(zip(cameras(10), spots, strict=True))]
    tracks = tracks_of(observations)
    assert [t.track_id for t in tracks] == [0]
    assert tracks[0].keyframes == tuple(range(10))


@pytest.mark.parametrize("after", [1, 2, 4])
def test_a_track_starts_when_it_was_consistent_for_so_many_frames(after):
    observations = [seen(k, T, [SPOTS[0]]) for k, T in enumerate(cameras(5))]
    for n in range(1, 6):
        tracks = tracks_of(observations[:n], replace(SETTINGS, start_after=after))
        assert len(tracks) == (n >= after)
        assert all(t.started == after - 1 for t in tracks)


@pytest.mark.parametrize("missed", [0, 1, 4, 5])
def test_a_track_that_has_not_started_outlives_misses_but_not_a_long_absence(missed):
    """Half a second between frames: at the fifth miss the last box is more than two seconds ago."""
    spots = [[SPOTS[0]], [SPOTS[0]], *([[]] * missed), [SPOTS[0]]]
    observations = [seen(k, T, s) for k, (T, s) in enumerate(zip(cameras(len(spots)), spots, strict=True))]
    tracks = tracks_of(observations)
    assert [t.started for t in tracks] == ([] if missed == 5 else [len(spots) - 1])


def test_a_thing_that_left_the_view_is_met_again_on_its_own_track():
    away = looking(yaw=0.0)
    away = away @ se3.exp(np.array([0.0, 1.5, 0.0, 0, 0, 0]))  # looks aside
    views = [*cameras(4), *([away] * 20), *[looking(yaw=0.5 + 0.01 * k) for k in range(4)]]
    observations = [seen(k, T, [] if 4 <= k < 24 else SPOTS[:2]) for k, T in enumerate(views)]
    tracks = tracks_of(observations)
    assert len(tracks) == 2
    assert all(t.keyframes == (*range(4), *range(24, 28)) for t in tracks)
    assert all(len(set(s)) == 1 for s in spots_of(tracks, observations))


def test_a_thing_at_another_place_is_another_track():
    observations = [seen(k, T, [SPOTS[0] if k < 5 else SPOTS[1]]) for k, T in enumerate(cameras(10))]
    tracks = tracks_of(observations)
    assert [t.keyframes for t in tracks] == [tuple(range(5)), tuple(range(5, 10))]


@settings(max_examples=10)
@given(st.integers(0, 2**31), st.permutations(range(3)))
def test_the_order_of_detections_changes_nothing_but_the_numbers_of_tracks(seed, order):
    rng = np.random.default_rng(seed)
    observations = []
    for k, T in enumerate(cameras(8)):
        observations.append(seen(k, T, SPOTS[rng.random(3) > 0.2], rng.normal()))
    shuffled = [
        replace(o, frame=replace(o.frame, detections=tuple(o.frame.detections[i] for i in order if i < n)))
        for o in observations
        for n in [len(o.frame.detections)]
    ]
    a, b = tracks_of(observations), tracks_of(shuffled)
    content = [{(t.keyframes, tuple(d.box for d in t.detections), t.started) for t in x} for x in (a, b)]
    assert content[0] == content[1]


@settings(max_examples=8)
@given(st.integers(0, 2**31))
def test_what_is_said_of_the_past_doesnt_change_with_the_future(seed):
    rng = np.random.default_rng(seed)
    observations = [seen(k, T, SPOTS[rng.random(3) > 0.3], rng.normal()) for k, T in enumerate(cameras(9))]
    whole = tracks_of(observations)
    for n in range(1, 9):
        begun = {t.track_id: t for t in tracks_of(observations[:n])}
        later = {t.track_id: t for t in whole if t.started is not None and t.started < n}
        assert begun.keys() == later.keys()
        for i, track in begun.items():
            kept = [k for k in later[i].keyframes if k < n]
            assert list(track.keyframes) == kept
            assert track.detections == later[i].detections[: len(kept)]


def test_a_good_match_is_not_given_up_for_two_bad_ones():
    """Overlaps 0.6, 0.35, 0.35 and 0: the two that are too small are no reason to leave the one that is not."""
    T = looking()
    depth = depth_of([], T)

    def keyframe(k, *lefts):
        boxes = [Detection((float(x), 100.0, 100.0, 60.0), np.array([0.2, 0.5, 0.3])) for x in lefts]
        return Observation(k, frame_of(k, T, depth, boxes), depth, ())

    associator = Associator(replace(SETTINGS, start_after=1, association_iou=0.4), CATALOGUE)
    associator.step(keyframe(0, 100.0, 172.0))
    associator.step(keyframe(1, 124.0, 52.0))
    kept = [t for t in associator.tracks() if len(t.keyframes) == 2]
    assert [[d.box[0] for d in t.detections] for t in kept] == [[100.0, 124.0]]


def test_a_box_without_depth_is_no_observation():
    T = looking()
    blind = Observation(0, frame_of(0, T, depth_of([], T), [box_at(SPOTS[0], T)]), np.zeros((240, 320), np.float32), ())
    assert tracks_of([blind], replace(SETTINGS, start_after=1)) == ()


def test_the_centre_depth_is_the_median_of_the_middle():
    depth = np.full((240, 320), 1.0, dtype=np.float32)
    depth[100:140, 100:140] = 0.5
    assert centre_depth(depth, np.array([100.0, 100.0, 40.0, 40.0])) == pytest.approx(0.5)
    assert centre_depth(depth, np.array([60.0, 60.0, 120.0, 120.0])) == pytest.approx(0.5)
    depth[100:140, 100:140] = 0.0
    assert centre_depth(depth, np.array([100.0, 100.0, 40.0, 40.0])) == 0.0
    assert centre_depth(depth, np.array([-50.0, -50.0, 20.0, 20.0])) == 0.0
    assert centre_depth(depth, np.array([400.0, 300.0, 20.0, 20.0])) == 0.0


def test_planes_of_a_keyframe_are_the_same_however_often_it_is_read():
    T = looking()
    frame = frame_of(3, T, depth_of([], T))
    a, b = observe(frame, 1, seed=0), observe(frame, 2, seed=0)
    assert len(a.planes) == 1
    np.testing.assert_array_equal(a.planes[0].normal, b.planes[0].normal)
    np.testing.assert_allclose(T[:3, :3] @ a.up_camera, [0, 0, 1], atol=0.01)


def walk(n, rng, visits=2):
    """A run of frames without images whose camera wanders."""
    frames, T = [], np.eye(4)
    for k in range(n):
        T = T @ se3.exp(rng.normal(size=6) * 0.05)
        frames.append(frame_of(k, T, np.zeros((240, 320), np.float32), visit=min(k * visits // n, visits - 1)))
    return run_of(CATALOGUE, frames)


@settings(max_examples=20)
@given(st.integers(0, 2**31), st.integers(1, 4), st.sampled_from([0.0, 0.1]), st.sampled_from([0.0, 0.1]))
def test_keyframes_are_chosen_by_the_past_alone(seed, every, metres, rad):
    rng = np.random.default_rng(seed)
    run = walk(20, rng)
    rule = Keyframes(every=every, min_translation_m=metres, min_rotation_rad=rad)
    chosen = select_keyframes(run, rule)
    assert {0, 10} <= set(chosen)
    assert (np.diff(chosen) > 0).all()
    for n in (1, 7, 10, 11, 15):
        cut = run_of(CATALOGUE, run.frames[:n])
        np.testing.assert_array_equal(select_keyframes(cut, rule), chosen[chosen < n])


def test_keyframes_obey_their_rule():
    run = walk(30, np.random.default_rng(0), visits=1)
    np.testing.assert_array_equal(select_keyframes(run, Keyframes()), np.arange(30))
    np.testing.assert_array_equal(select_keyframes(run, Keyframes(every=4)), np.arange(0, 30, 4))
    chosen = select_keyframes(run, Keyframes(min_translation_m=0.15))
    assert 2 < len(chosen) < 30
    at = [f.T_world_camera[:3, 3] for f in run.frames]
    for a, b in pairwise(chosen):
        assert np.linalg.norm(at[b] - at[a]) >= 0.15
        assert all(np.linalg.norm(at[k] - at[a]) < 0.15 for k in range(a + 1, b))
    still = run_of(CATALOGUE, [frame_of(k, np.eye(4), np.zeros((240, 320), np.float32)) for k in range(5)])
    np.testing.assert_array_equal(select_keyframes(still, Keyframes(min_translation_m=0.1, min_rotation_rad=0.1)), [0])


def test_a_box_that_the_images_edge_cuts_is_met_by_its_place_and_class():
    """Only a part of it is boxed, so boxes don't overlap enough; a box of another class there is another track."""
    scores = np.array([0.02, 0.02, 0.96])
    other = np.array([0.02, 0.96, 0.02])

    def part(k, T, low, high, says):
        whole = box_at(SPOTS[0], T).box
        box = (whole[0] + low * whole[2], whole[1], (high - low) * whole[2], whole[3])
        depth = depth_of([], T)
        return Observation(k, frame_of(k, T, depth, [Detection(box, says)]), depth, ())

    views = [part(k, T, 0.0, 1.0, scores) for k, T in enumerate(cameras(3))]
    T = cameras(4)[3]
    assert [t.keyframes for t in tracks_of([*views, part(3, T, 0.7, 1.0, scores)])] == [(0, 1, 2, 3)]
    assert [t.keyframes for t in tracks_of([*views, part(3, T, 0.7, 1.0, other)])] == [(0, 1, 2)]
