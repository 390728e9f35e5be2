"""The limits that a result has to keep to pass; the configuration's `[calibration.gates]` sets them."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from surfclass.schema import Number, Positive, Table


class CamerasGates(Table):
    """Of `calibrate cameras`.

    Attributes:
        rms_px: Root mean square of the corners' distances in each camera.
        held_out_px: Root mean square over the views, each with cameras found without it.
        projection_px: Standard deviation of where a point projects, at its worst in the central 80 % of
            the image of the first camera or the second.
        translation_sd_m: Of one camera in the other's frame, along its worst axis.
        rotation_sd_rad: Likewise, about its worst axis.
        coverage: Share of the image's 5 × 4 parts in which corners were seen.
        outlier_views: So many views may not fit and be left out.
        depth_rms: Relative, of the depth readings on boards that were held out, corrected.
    """

    rms_px: Positive = 0.5
    held_out_px: Positive = 0.7
    projection_px: Positive = 1.5
    translation_sd_m: Positive = 0.002
    rotation_sd_rad: Positive = 0.003
    coverage: Annotated[Number, Field(ge=0, le=1)] = 0.5
    outlier_views: Annotated[int, Field(ge=0)] = 2
    depth_rms: Positive = 0.01


class HandEyeGates(Table):
    """Of `calibrate hand-eye`.

    Attributes:
        translation_sd_m: Standard deviation of the transform's translation along its worst axis.
        rotation_sd_rad: Likewise of its rotation about its worst axis.
        leave_one_out_px: Rms over the pixels of each pose, predicted by the other poses.
        leave_one_out_m: Likewise of points that were measured in space.
        outlier_poses: So many poses may not fit and be left out.
    """

    translation_sd_m: Positive = 0.002
    rotation_sd_rad: Positive = 0.003
    leave_one_out_px: Positive = 3.0
    leave_one_out_m: Positive = 0.005
    outlier_poses: Annotated[int, Field(ge=0)] = 0


class LightGates(Table):
    """Of `calibrate light`.

    Attributes:
        position_sd_m: Standard deviation of the light's position along its most uncertain direction.
        k_d_variation: Standard deviation over mean of K_d, over all pixels of targets that are of one K_d.
        held_out: Rms of the relative error of a left-out view's light, up to its K_d.
    """

    position_sd_m: Positive = 0.010
    k_d_variation: Positive = 0.03
    held_out: Positive = 0.02


class ResponseGates(Table):
    """Of `calibrate response`.

    Attributes:
        held_out: Rms error of predicting a left-out exposure (or view) from the others, of full scale.
        curve_sd: Rms standard deviation of g⁻¹ over the intensities that were seen, relative to g⁻¹.
        least_range: The intensities that were seen must cover this share of full scale.
    """

    held_out: Positive = 0.01
    curve_sd: Positive = 0.02
    least_range: Positive = 0.5


class LimitsGates(Table):
    """Of `calibrate limits`.

    Attributes:
        captures: The fewest labelled captures.
        distance_ratio: The least that the farthest windows are away, over the nearest.
        angle_span_rad: The least between the most direct and the most oblique windows.
        gain: The least that a window of another capture is more likely under the new limits than under
            those in use, nats; a standard error below it still passes.
        classes: The least share of classes that have limits of their own.
    """

    captures: Positive = 6
    distance_ratio: Positive = 1.3
    angle_span_rad: Positive = 0.35
    gain: Number = 0.0
    classes: Annotated[Positive, Field(le=1)] = 0.5


class TrainGates(Table):
    """Of `train`: on places that the model was not trained on, of the colour feature in use and of texture.

    How good a model can be depends on the surfaces: the defaults refuse only what is no use at all.

    Attributes:
        colour_accuracy: The least share of samples that are right, mean over the classes.
        texture_accuracy: Likewise, of windows.
        ece: The greatest expected calibration error.
    """

    colour_accuracy: Annotated[Positive, Field(le=1)] = 0.4
    texture_accuracy: Annotated[Positive, Field(le=1)] = 0.3
    ece: Annotated[Positive, Field(le=1)] = 0.25


class VerifyGates(Table):
    """Of `verify`.

    Attributes:
        point_rms_m: Rms distance of a disc, seen from a new pose, from where it was touched.
        point_max_m: The greatest such distance.
        k_d_variation: Standard deviation over mean of a grey card's K_d, over all places of all captures.
        k_d_between: The same between the captures' means.
        accuracy: Share of labelled pixels that the model must get right.
        class_accuracy: The same of the worst class.
        reprojection_px: Rms distance of a board's corners in the IR image from the board's pose.
        transfer_px: The same in the colour image, from the pose that the IR image gives.
        depth_error: Relative error of depth on the board.
    """

    point_rms_m: Positive = 0.003
    point_max_m: Positive = 0.010
    k_d_variation: Positive = 0.02
    k_d_between: Positive = 0.015
    accuracy: Annotated[Positive, Field(le=1)] = 0.85
    class_accuracy: Annotated[Positive, Field(le=1)] = 0.70
    reprojection_px: Positive = 1.0
    transfer_px: Positive = 1.5
    depth_error: Positive = 0.01


class Gates(Table):
    """Every step's limits."""

    cameras: CamerasGates = CamerasGates()
    hand_eye: HandEyeGates = HandEyeGates()
    light: LightGates = LightGates()
    response: ResponseGates = ResponseGates()
    limits: LimitsGates = LimitsGates()
    train: TrainGates = TrainGates()
    verify: VerifyGates = VerifyGates()
