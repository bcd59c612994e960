"""Detection on synthetic captures: an artifact that is static to the pixel is found, recurring content is not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ssa_nerfstudio.evidence import detection, edge_evidence, static_area
from ssa_nerfstudio.evidence.detection import detect
from ssa_nerfstudio.evidence.statistics import ImageStatistics, accumulate

HEIGHT, WIDTH = 96, 128


def texture(rng: np.random.Generator, size: int) -> np.ndarray:
    """Noise with structure at all scales, [size, size, 3] in [0, 1]."""
    total = np.zeros((size, size, 3))
    for cells in (4, 16, 64, size):
        coarse = rng.random((cells, cells, 3))
        total += np.kron(coarse, np.ones((size // cells, size // cells, 1)))
    return (total - total.min()) / np.ptp(total)


def capture(views: int, seed: int = 0) -> list[np.ndarray]:
    """Photos of a textured wall from changing places, uint8."""
    rng = np.random.default_rng(seed)
    wall = texture(rng, 512)
    corners = rng.integers(0, 512 - max(HEIGHT, WIDTH), (views, 2))
    return [(wall[y : y + HEIGHT, x : x + WIDTH] * 255).round().astype(np.uint8) for y, x in corners]


def behind(photos: list[np.ndarray], alpha: np.ndarray, color: float = 0.9) -> list[np.ndarray]:
    """The same with a layer of this matte [H, W] in front."""
    alpha = alpha[..., None]
    return [(photo * (1 - alpha) + 255 * color * alpha).round().astype(np.uint8) for photo in photos]


def statistics_of(photos: list[np.ndarray]) -> ImageStatistics:
    return accumulate((torch.from_numpy(photo), None) for photo in photos)


def logo(alpha: float) -> np.ndarray:
    matte = np.zeros((HEIGHT, WIDTH))
    for x in range(30, 100, 12):
        matte[40:56, x : x + 6] = alpha
    return matte


def board() -> np.ndarray:
    matte = np.zeros((HEIGHT, WIDTH))
    matte[70:] = 1.0
    return matte


@pytest.mark.parametrize("views", [12, 25, 50])
@pytest.mark.parametrize("seed", range(3))
def test_a_capture_without_artifact_has_verdict_none(views, seed):
    found = detect(statistics_of(capture(views, seed)))
    assert found.verdict == "none"
    assert found.coverage == 0
    assert not found.mask.any()


@pytest.mark.parametrize("views", [12, 25, 50])
def test_a_faint_logo_is_found_where_it_is(views):
    found = detect(statistics_of(behind(capture(views), logo(0.4))))
    assert found.verdict == "faint"
    assert found.views == views
    assert found.p_value == 1 / (1 + detection.DRAWS)
    assert found.mask[40:56, 30:96].float().mean() > 0.5
    away = found.mask.clone()
    away[36:60, 26:100] = False
    assert away.float().mean() < 0.01
    assert found.coverage == pytest.approx(float(found.mask.float().mean()))


def test_an_opaque_board_is_found_with_its_uniform_inside():
    found = detect(statistics_of(behind(capture(25), board())))
    assert found.verdict == "opaque"
    assert found.mask[72:].all()
    assert found.mask[:66].float().mean() < 0.01


@pytest.mark.parametrize("views", [17, 20, 24, 33, 40])
def test_a_plain_bar_is_covered_whatever_the_number_of_views(views):
    """Its contrast falls along its outline: in the lower half the static edges are too weak by themselves."""
    brightness = np.linspace(0.9, 0.1, HEIGHT)[:, None, None]
    photos = [(photo * brightness).astype(np.uint8) for photo in capture(views)]
    matte = np.zeros((HEIGHT, WIDTH))
    matte[:, 96:112] = 1.0
    found = detect(statistics_of(behind(photos, matte, color=0.05)))
    assert found.mask[4:-4, 98:110].float().mean() > 0.95
    assert found.verdict == "opaque"


@pytest.mark.parametrize("views", [12, 40])
def test_a_uniform_corner_is_found_though_it_has_few_edges(views):
    """A thumb, a tripod's leg: 6 % of the frame, whose edges alone would be too few to report."""
    matte = np.zeros((480, 640))
    matte[360:, :160] = 1.0
    photos = behind([cv2.resize(photo, (640, 480)) for photo in capture(views)], matte)
    found = detect(statistics_of(photos))
    assert detection._strength(found.shares) < 1
    assert found.verdict == "opaque"
    assert found.mask[362:, :158].all()
    assert found.coverage == pytest.approx(0.0625, abs=0.02)


def draw_sky(photos: list[np.ndarray], horizon: int, seed: int) -> None:
    """Draw a plain sky into photos, down to a border around a row, which moves from photo to photo."""
    rng = np.random.default_rng(seed)
    for photo in photos:
        height, width, _ = photo.shape
        waves = 6 * np.sin(np.arange(width) / 9 + rng.uniform(0, 6)) + rng.uniform(-6, 6)
        photo[np.arange(height)[:, None] < horizon + np.round(waves).astype(int)] = (140, 170, 230)


def test_a_uniform_sky_without_static_edges_is_no_artifact():
    """All views agree on the upper half; its lower border moves, as a skyline does. The board below does not."""
    photos = behind(capture(30), board())
    draw_sky(photos, 40, seed=5)
    statistics = statistics_of(photos)
    assert float(statistics.deviation()[:24].max()) == 0
    found = detect(statistics)
    assert not found.mask[:24].any()
    assert found.mask[72:].all()
    assert not found.opaque[:24].any()
    assert found.opaque[76:].all()


def before_a_sky(views: int) -> list[np.ndarray]:
    """Photos of 384 x 512 pixels: a plain sky, whose lower border moves, over the textured wall."""
    photos = [cv2.resize(photo, (512, 384)) for photo in capture(views)]
    draw_sky(photos, 160, seed=2)
    return photos


def rain(density: float, side: int = 5, opacity: float = 0.4) -> np.ndarray:
    """The matte of square drops, [384, 512]; the density is that of drops of 5 x 5 pixels over the same area."""
    drops = (np.random.default_rng(3).random((384, 512)) < density * 25 / side**2).astype(np.uint8)
    return opacity * cv2.dilate(drops, np.ones((side, side), np.uint8)).astype(np.float64)


@pytest.mark.parametrize("masked", [0, 77, 173])
@pytest.mark.parametrize("density", [0.012, 0.03, 0.05])
def test_a_uniform_sky_behind_rain_is_not_opaque(density, masked):
    """The skyline is static edges, but so is nearly everything that photos show; rows below may be masked."""
    seen = torch.ones(384, 512, dtype=torch.bool)
    seen[384 - masked :] = False
    photos = behind(before_a_sky(30), rain(density))
    found = detect(accumulate((torch.from_numpy(photo), seen) for photo in photos))
    assert found.verdict != "none"
    assert not found.opaque.any()


def test_drops_that_hide_most_of_a_sky_are_not_opaque():
    """They vary less than a fifth of the wall, and join to areas with edges all around, like all of the frame."""
    assert not detect(statistics_of(behind(before_a_sky(30), rain(0.03, 9, 0.7)))).opaque.any()


@pytest.mark.parametrize("density", [0.0, 0.012, 0.03, 0.05])
@pytest.mark.parametrize("size", [(90, 140), (40, 60)])
def test_a_panel_is_opaque_in_front_of_rain(density, size):
    """Its outline is edges like all around it, but it hides the drops."""
    panel = np.zeros((384, 512))
    panel[250 : 250 + size[0], 60 : 60 + size[1]] = 1.0
    found = detect(statistics_of(behind(behind(before_a_sky(30), rain(density)), panel, 0.1)))
    assert not found.opaque[:200].any()
    assert found.opaque[252 : 248 + size[0], 62 : 58 + size[1]].all()


@pytest.mark.parametrize(
    ("share", "inside", "usual", "enclosed"),
    [
        (1.0, 1.0, 0.1, True),
        (0.55, 1.0, 0.1, True),
        (0.45, 1.0, 0.1, False),
        (0.45, 0.0, 0.9, False),
        (0.9, 0.9, 0.9, False),
        (0.9, 0.9, 0.8, False),
        (0.9, 0.3, 0.9, True),
        (0.9, 0.75, 0.9, True),
        (0.9, 0.85, 0.9, False),
        (1.0, 1.0, 1.0, False),
        (0.6, 0.0, 0.0, True),
    ],
)
def test_an_outline_has_more_edges_than_by_chance_or_surrounds_fewer(share, inside, usual, enclosed):
    """A square of 60 pixels, of whose outline and inside these shares are edges."""
    area = np.zeros((80, 80), np.uint8)
    area[10:70, 10:70] = 1
    rank = np.random.default_rng(4).permutation(6400).reshape(80, 80)
    edges = np.zeros((80, 80), np.uint8)
    for part, wanted in ((cv2.dilate(area, np.ones((3, 3), np.uint8)) > area, share), (area > 0, inside)):
        edges[part] = rank[part].argsort().argsort() < wanted * part.sum()
    assert static_area._has_outline(edges, area, usual) == enclosed


def test_recurring_content_that_moves_is_no_artifact():
    """A dark square in the middle of every view, as when walking around something: never twice at the same pixels."""
    photos = capture(40)
    rng = np.random.default_rng(1)
    for photo in photos:
        y, x = rng.integers(20, 40), rng.integers(30, 60)
        photo[y : y + 30, x : x + 30] //= 3
    assert detect(statistics_of(photos)).verdict == "none"


def distant(views: int, seed: int = 0) -> list[np.ndarray]:
    """Photos of soft clouds from a hand that trembles by up to two pixels, uint8."""
    rng = np.random.default_rng(seed)
    clouds = cv2.GaussianBlur(rng.random((HEIGHT + 8, WIDTH + 8, 3)), (0, 0), 4)
    clouds = (clouds - clouds.min()) / np.ptp(clouds)
    photos = []
    for x, y in rng.uniform(2, 6, (views, 2)):
        place = np.array([[1.0, 0.0, x], [0.0, 1.0, y]])
        moved = cv2.warpAffine(clouds, place, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        photos.append((255 * moved + rng.normal(0, 1, moved.shape)).round().clip(0, 255).astype(np.uint8))
    return photos


@pytest.mark.parametrize("views", [8, 12, 40])
def test_a_trembling_camera_is_no_artifact_though_edges_hardly_move(views, monkeypatch):
    statistics = statistics_of(distant(views))
    found = detect(statistics)
    assert found.verdict == "none"
    assert max(found.shares) < 0.003
    monkeypatch.setattr(edge_evidence, "MAX_DISPLACED_SHARES", (1.0, 1.0))
    assert detect(statistics).verdict != "none", "without the test for displacements it would be one"


@pytest.mark.parametrize("views", [8, 12, 40])
def test_an_artifact_is_found_with_a_trembling_camera(views):
    photos = distant(views)
    panel = texture(np.random.default_rng(1), 128)[: HEIGHT - 70] * 255
    for photo in photos:
        photo[70:] = panel
    found = detect(statistics_of(photos))
    assert found.verdict == "opaque"
    assert found.mask[72:].float().mean() > 0.9


def test_vignetting_alone_is_no_artifact():
    y, x = np.mgrid[-1 : 1 : HEIGHT * 1j, -1 : 1 : WIDTH * 1j]
    fall = 1 - 0.15 * (x**2 + y**2)
    photos = [(photo * fall[..., None]).astype(np.uint8) for photo in capture(40)]
    assert detect(statistics_of(photos)).verdict == "none"


def test_gradients_below_the_minimum_do_not_count():
    """A pattern of one gray level on equal photos: all views agree exactly, and it is invisible."""
    photo = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    photo[::2] += 1
    assert detect(statistics_of([photo] * 20)).verdict == "none"


def test_identical_photos_are_artifact_everywhere():
    """Nothing moves: the camera stood still, and scene and artifact cannot be separated."""
    found = detect(statistics_of(capture(1) * 20))
    assert found.verdict == "opaque"
    assert found.coverage > 0.9


def test_too_few_views_have_verdict_none():
    found = detect(statistics_of(behind(capture(5), board())))
    assert found.verdict == "none"
    assert found.p_value == 1.0
    assert found.p_interval == (0.0, 1.0)


def test_detection_is_reproducible_and_leaves_global_random_state_alone():
    statistics = statistics_of(behind(capture(12), logo(0.2)))
    torch.manual_seed(1)
    np.random.seed(1)  # noqa: NPY002 - the state that must not change
    before = torch.get_rng_state()
    first, second = detect(statistics), detect(statistics)
    assert torch.equal(before, torch.get_rng_state())
    after = np.random.random(3)  # noqa: NPY002
    np.random.seed(1)  # noqa: NPY002
    assert (after == np.random.random(3)).all()  # noqa: NPY002
    assert first.null_shares == second.null_shares
    assert torch.equal(first.mask, second.mask)
    assert detect(statistics, seed=1).verdict == first.verdict


@pytest.mark.parametrize("masked", [0, 40, 60])
def test_an_opaque_button_is_found_beside_a_mask_of_much_of_the_frame(masked):
    """Columns that no photo shows are no part of how much the views vary."""
    button = np.zeros((HEIGHT, WIDTH))
    button[20:50, 80:120] = 1.0
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, :masked] = False
    photos = [torch.from_numpy(photo) for photo in behind(capture(25), button)]
    found = detect(accumulate((photo, mask) for photo in photos))
    assert found.verdict == "opaque"
    assert (found.opaque.numpy() == (button > 0)).mean() > 0.99


def test_masked_pixels_cause_no_edge():
    """Black below a user's mask that is the same in all views: its outline must not be taken for an artifact."""
    seen = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    seen[60:, 20:80] = False
    found = detect(accumulate((torch.from_numpy(photo), seen) for photo in capture(25)))
    assert found.verdict == "none"
    found = detect(accumulate((torch.from_numpy(photo), seen) for photo in behind(capture(25), logo(0.4))))
    assert found.verdict == "faint"


def test_masks_that_differ_between_views_cause_no_edge():
    rng = np.random.default_rng(0)
    views = []
    for photo in capture(25):
        y, x = rng.integers(0, 60, 2)
        seen = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
        seen[y : y + 30, x : x + 40] = False
        views.append((torch.from_numpy(photo), seen))
    assert detect(accumulate(views)).verdict == "none"


def test_the_dtype_of_the_photos_changes_nothing():
    photos = behind(capture(16), logo(0.4))
    bytes_, words, floats = (
        accumulate((torch.from_numpy(convert(photo)), None) for photo in photos)
        for convert in (lambda p: p, lambda p: p.astype(np.uint16) * 257, lambda p: p.astype(np.float32) / 255)
    )
    assert torch.allclose(detect(bytes_).evidence, detect(words).evidence, rtol=1e-3, atol=1e-3)
    assert torch.allclose(detect(bytes_).evidence, detect(floats).evidence, rtol=1e-3, atol=1e-3)


@settings(max_examples=20, deadline=None)
@given(height=st.integers(1, 40), width=st.integers(1, 40), views=st.integers(1, 20))
def test_any_frame_and_number_of_views_gives_a_mask_of_its_size(height, width, views):
    rng = np.random.default_rng(height * 41 + width)
    photos = [torch.from_numpy(rng.integers(0, 256, (height, width, 3), dtype=np.uint8)) for _ in range(views)]
    statistics = accumulate((photo, None) for photo in photos)
    found = detect(statistics, draws=5)
    assert found.mask.shape == found.opaque.shape == (height, width)
    assert 0 < found.p_value <= 1
    low, high = found.p_interval
    assert 0 <= low < high <= 1


@pytest.mark.parametrize(("exceeding", "verdict"), [(0, "faint"), (1, "faint"), (2, "none"), (39, "none")])
def test_an_artifact_is_reported_at_one_percent(exceeding, verdict, monkeypatch):
    """1 of 200 shifted captures has as many edges: p = 2 / 201; 2 of 200: more than one percent."""
    statistics = statistics_of(behind(capture(12), logo(0.4)))
    draws = [(1.0, 1.0)] * exceeding + [(0.0, 0.0)] * (200 - exceeding)
    monkeypatch.setattr(detection, "null_shares", lambda *_: iter(draws))
    found = detect(statistics)
    assert found.verdict == verdict
    assert found.p_value == pytest.approx((1 + exceeding) / 201)
    assert not found.too_few_edges


def test_edges_that_shifted_captures_have_as_well_do_not_count(monkeypatch):
    """Fewer than the capture, so that it is significant, but so many that what is left is too little."""
    statistics = statistics_of(behind(capture(12), logo(0.4)))
    shares = detect(statistics).shares
    draw = tuple(share - 0.9 * least for share, least in zip(shares, edge_evidence.MIN_EDGE_SHARES, strict=True))
    monkeypatch.setattr(detection, "null_shares", lambda *_: iter([draw] * 200))
    found = detect(statistics)
    assert found.verdict == "none"
    assert found.too_few_edges
    assert found.null_shares == pytest.approx(draw)


@pytest.mark.parametrize(("views", "tested"), [(5, False), (6, True)])
def test_six_views_are_enough_to_say_something(views, tested):
    found = detect(statistics_of(behind(capture(views), board())), draws=100)
    assert (found.p_value < 1) == tested
    assert found.views == views
    assert max(found.shares) > 0
    assert not found.opaque[:60].any()
    assert bool(found.mask.any()) == (found.verdict != "none")
