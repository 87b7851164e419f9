"""Captions of the pictures of a run, and their order in its report."""

from __future__ import annotations

from pathlib import Path

from ..common.display import Picture, own_pictures

# Captions of the pictures of every run in the order of a report, by the beginning of their names.
PICTURE_CAPTIONS = {
    "stress": "Stress over strain: measured, fitted and simulated.",
    "force_displacement": "Force over displacement: measured, fitted and simulated.",
    "depth": "Points of a depth camera with the outline of the fitted surface, at up to four samples, "
    "and the distance of each point behind the surface; grey points are not compared.",
    "outline": "Edge of the masks (grey) and contour of the fitted body (red) in up to four images.",
    "image": "First and worst image of a camera: tracks of the points (grey), contour of the fitted "
    "body (red), measured points, and enlarged errors of the fit as arrows.",
    "shapes": "The fitted body at several times of the recording; orange: measured markers.",
    "field": "Spatially varying constant between the ends of its 95 % interval; below, a cut "
    "through the body. Pale colours: the data add little to the prior.",
    "mesh": "The mesh, its grasped nodes and the estimated positions of the markers.",
    "pressure": "Pressure of obstacles on the body.",
    "gap": "Gap between the body's surface and obstacles.",
    "tracks": "Measured, fitted and simulated markers, the residual below.",
    "wrench": "Wrench of a grasp: measured, fitted and simulated.",
    "pixels": "Image tracks: measured, fitted and simulated pixels.",
    "reading": "Custom sensor: measured, fitted and simulated.",
    "modulus": "Modulus over frequency or time: measured, fitted and simulated.",
    "error": "Distance of the markers from their measurements over time.",
    "spectrum": "Spectrum of the motion against the body's first natural frequencies.",
    "confidence": "95 % regions of pairs of parameters, for the combined uncertainty if it is known.",
    "combinations": "95 % intervals of the constants alone and, below the line, of their independent "
    "combinations. Blue: narrower than the value; orange: not determined.",
    "correlation": "Correlation of the estimates, for the same uncertainty.",
    "budget": "Contributions to the variance of each estimate.",
    "convergence": "Loss, violation of the dynamics, trust region, noise of the loss and parameters "
    "over the iterations.",
    "scan": "Scan of the stiffness for an initial guess: misfit of the first part of the "
    "recordings.",
    "elements": "Size and quality of the elements.",
    "jacobian": "Structure of the constraints' Jacobian.",
}


# Pictures that show measurement and fit, one of which leads the page.
LEADING_PICTURES = (
    "stress",
    "modulus",
    "tracks",
    "wrench",
    "force_displacement",
    "reading",
    "depth",
    "outline",
    "image",
)


def captioned_pictures(run: Path) -> list[Picture]:
    """Return every PNG file of the folder `run`, also those of other programs, with its caption;
    links that lead out of the folder are left out.

    A picture that compares measurement and fit is first; then follow the pictures known to
    `PICTURE_CAPTIONS` in that order, and unknown ones, with their name as caption. Empty without
    pictures.
    """
    order = [*PICTURE_CAPTIONS, ""]
    pictures: list[Picture] = []

    def kind(file: Path) -> str:
        return next(k for k in order if file.stem.startswith(k))

    for file in sorted(own_pictures(run), key=lambda file: (order.index(kind(file)), file.name)):
        about = file.stem.removeprefix(kind(file)).strip("_")
        caption = PICTURE_CAPTIONS.get(kind(file), file.stem)
        pictures.append(Picture(file, f"{about}: {caption}" if about and kind(file) else caption))
    compared = (each for each in pictures if kind(each.file) in LEADING_PICTURES)
    first = next(compared, None)
    return pictures if first is None else [first, *(p for p in pictures if p is not first)]
