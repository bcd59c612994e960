"""Names of cameras, from the names of their photos."""

from __future__ import annotations

import pytest

from ssa_nerfstudio.cameras.camera_names import camera_names, camera_of_folder


@pytest.mark.parametrize(
    ("photos", "names"),
    [
        ([["images/front_00001.jpg", "images/front_00012.jpg"], ["images/side_00001.jpg"]], ["front", "side"]),
        ([["images/left/1.png", "images/left/20.png"], ["images/right/1.png"]], ["left", "right"]),
        ([["images_2/frame_up_00001.png"], ["images_2/frame_down_00001.png"]], ["frame_up", "frame_down"]),
        ([["images/cam1_00001.jpg", "images/cam1_00002.jpg"], ["images/cam2_00001.jpg"]], ["cam1", "cam2"]),
        ([["images/gopro7_front-left_01.jpg"], ["images/gopro7_rear_01.jpg"]], ["gopro7_front-left", "gopro7_rear"]),
        ([["images/camera_0_00001.jpg"], ["images/camera_1_00001.jpg"]], ["camera_0", "camera_1"]),
        ([["images/DSC_0003.jpg", "images/DSC_0001.jpg"], ["images/DSC_0002.jpg"]],
         ["camera_of_DSC_0001", "camera_of_DSC_0002"]),
        ([["images/cat.jpg", "images/car.jpg"], ["images/dog.jpg"]], ["camera_of_car", "camera_of_dog"]),
        ([["images/front_a.jpg", "images/front_b.jpg"], ["images/rear_a.jpg", "images/rear_b.jpg"]], ["front", "rear"]),
        ([["1.jpg"], ["2.jpg"]], ["camera_of_1", "camera_of_2"]),
        ([["images/a/1.jpg", "images/b/2.jpg"], ["images/b/1.jpg", "images/c/3.jpg"]], ["camera_0", "camera_1"]),
        ([["images/gopro 2/a 1.jpg", "images/gopro 2/b.jpg"], ["images/phone/x1.jpg", "images/phone/y.jpg"]],
         ["gopro 2", "phone"]),
        ([["images/frame_00001.jpg", "images/frame_00002.jpg"]], ["camera_0"]),
    ],
)  # fmt: skip
def test_a_camera_is_called_what_its_photos_have_in_common(photos, names):
    assert camera_names(photos) == names


@pytest.mark.parametrize("folder", ["front", "Cam #1 [front]", "side-2", "seite ä.", "cam 1 "])
def test_a_camera_of_a_folder_is_called_the_same_before_and_after_its_photos_are(folder):
    name = camera_of_folder(folder)
    photos = [[f"images/{each}_{number:05d}.jpg" for number in (1, 2)] for each in (name, "other")]
    assert camera_names(photos) == [name, "other"]
