"""What photos show of the scene: which are read, and that the layers of each are its own."""

from __future__ import annotations

import pytest
import torch

from ssa_nerfstudio.evidence import scene_photos as scene_photos_module
from ssa_nerfstudio.evidence.point_samples import View
from ssa_nerfstudio.evidence.scene_photos import MAX_VIEWS, MIN_SHOWN, near_points, projections, scene_photos
from ssa_nerfstudio.overlay.layer import HIDDEN_BELOW

HEIGHT, WIDTH = 12, 16


def view(color: float, mask: torch.Tensor | None = None) -> View:
    return View(torch.full((HEIGHT, WIDTH, 3), color), mask, torch.eye(4), torch.eye(3))


def test_no_more_views_are_read_than_the_most_and_each_group_keeps_its_share() -> None:
    photos = scene_photos([view(0.5)] * 280, [None] * 280, [number % 7 for number in range(280)])
    assert MAX_VIEWS // 2 < len(photos) <= MAX_VIEWS
    groups = [photo.group for photo in photos]
    assert groups == sorted(groups)
    assert all(groups.count(group) in (13, 14) for group in range(7))


def test_the_scene_is_what_is_left_of_the_artifact_that_a_view_has() -> None:
    T, B = torch.full((HEIGHT, WIDTH, 1), 0.8), torch.full((HEIGHT, WIDTH, 3), 0.1)
    T[:, : WIDTH // 2] = 0.9 * MIN_SHOWN
    mask = torch.ones(HEIGHT, WIDTH)
    mask[0] = 0
    film, nothing, masked = (
        photo for photo in scene_photos([view(0.58), view(0.6), view(0.6, mask)], [(T, B), None, None], [0, 1, 1])
    )
    torch.testing.assert_close(film.color[:, WIDTH // 2 :], torch.full((HEIGHT, WIDTH // 2, 3), 0.6))
    assert film.shown[:, WIDTH // 2 :].all()
    assert not film.shown[:, : WIDTH // 2].any()
    torch.testing.assert_close(nothing.color, torch.full((HEIGHT, WIDTH, 3), 0.6))
    assert nothing.shown.all()
    assert masked.shown[1:].all()
    assert not masked.shown[0].any()
    assert film.size == (HEIGHT, WIDTH)


def test_between_shown_and_hidden_a_film_leaves_something_of_the_scene() -> None:
    T = torch.full((HEIGHT, WIDTH, 1), 1.1 * HIDDEN_BELOW)
    T[:, : WIDTH // 2] = 0.9 * HIDDEN_BELOW
    mask = torch.ones(HEIGHT, WIDTH)
    mask[0] = 0
    # Transmittances may differ between the colors.
    layers = T * torch.tensor([0.5, 1.0, 1.5]), torch.zeros(HEIGHT, WIDTH, 3)
    [dark, both, masked] = scene_photos(
        [view(0.05), view(0.05, mask), view(0.6, mask)], [layers] * 2 + [None], [0, 0, 1]
    )
    assert not dark.shown.any()
    assert dark.hidden[:, : WIDTH // 2].all()
    assert not dark.hidden[:, WIDTH // 2 :].any()
    assert torch.equal(masked.hidden, ~masked.shown)
    assert torch.equal(both.hidden, dark.hidden | masked.hidden)
    assert masked.hidden[0].all()


@pytest.mark.parametrize("at_once", [2, 3, 100])
def test_photos_that_are_projected_into_together_give_what_each_gives_alone(monkeypatch, at_once) -> None:
    generator = torch.Generator().manual_seed(0)
    positions = torch.rand(50, 3, generator=generator) * 2 - torch.tensor([1.0, 1.0, 0.3])
    lens = torch.tensor([[10.0, 0, WIDTH / 2], [0, 10, HEIGHT / 2], [0, 0, 1]])
    views = []
    for number in range(7):  # the fifth has another size
        pose = torch.eye(4)
        pose[:3, 3] = torch.rand(3, generator=generator) / 2
        height = HEIGHT + 4 * (number == 4)
        views.append(View(torch.rand(height, WIDTH, 3, generator=generator), None, pose, lens))
    photos = scene_photos(views, [None] * 7, [0] * 7)
    pictures = [photo.color for photo in photos]

    def found() -> tuple[list[torch.Tensor], list[torch.Tensor]]:
        parts = list(projections(positions, photos))
        assert [part.first for part in parts] == [sum(len(p.photos) for p in parts[:at]) for at in range(len(parts))]
        pairs = [(part.view + part.first, part.index, part.pixel, part.read(pictures)) for part in parts]
        return [torch.cat(each) for each in zip(*pairs, strict=True)], near_points(positions, photos, 1)

    (number, index, pixel, color), near = found()
    monkeypatch.setattr(scene_photos_module, "photos_at_once", lambda device, values: at_once)
    together, near_together = found()
    assert all(map(torch.equal, (number, index, pixel, color), together))
    assert all(map(torch.equal, near, near_together))
    assert len(set(number.tolist())) == 7
    for at, photo in enumerate(photos):
        own = number == at
        torch.testing.assert_close(color[own], photo.color.flatten(0, 1)[pixel[own]], rtol=0, atol=0)
        assert near[at].flatten()[pixel[own]].all()
        assert not near[at].all()
