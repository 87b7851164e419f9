"""Messages of the likely mistakes, by their codes after "description/"."""

from __future__ import annotations

MESSAGES = {
    "poses-inverted": "the markers move as if the poses were inverted: invert them; a pose must "
    "map the undeformed body to its current position",
    "quaternion-order": "the markers move as if the quaternions were in another order: set "
    'grasp.quaternion = "{order}" or swap the columns',
    "length-unit": "{who} were {factor:g} times as large: {remedy}",
    "gravity": "the markers hang as if gravity were along {axis}: set gravity_m_s2 = [{vector}]",
    "gripper-frame": "the markers move with the poses, but with a constant transform between "
    "them: the mesh is not given in the frame whose poses were recorded; multiply every pose on "
    "the right by the transform from the mesh's frame to the gripper's, or fit the poses by "
    "grasp.markers",
    "camera-frame": "the markers fit after one rigid motion of all of them: cameras and robot "
    "use different world frames; set markers.template_m and template_window_s",
    "frames": "{fault}",
    "clock/slow": "the times of the markers seem {factor:g} times too long, as those of a slow-motion "
    "film: divide t_s of the markers by {factor:g}",
    "clock": "the markers' clock is {when} by about {by_ms:.3g} ms relative to that of the "
    "poses: {do} t_s of the poses, or estimate it with nuisance.time_shift",
    "grasp-layer": "the fit is better if the grasp holds one layer of nodes {deep} than stated: "
    "compare the box of grasp.nodes with the ends of the fingers",
    "markers-exchanged": "the names of markers are exchanged: {names}; correct markers.labels or "
    "reference_m",
    "markers-exchanged/later": "the names of markers are exchanged {when}: {names}; correct them "
    "there, or remove these samples",
    "hysteresis": "the force in unloading differs from that in loading by {sizes}, and an "
    "elastic law is fitted between both branches: this is hysteresis of the material. To fit the "
    "loading alone, end window_s at the largest displacement",
    "law": "the material deforms by another law than stated, such as {material}: compare laws "
    "with compare-models --materials",
    "law/both": "material and damping obey other laws than stated, such as {material} with "
    "{damping}: compare laws with compare-models --materials and --damping",
    "mesh-section": "the section of the body is {real}, and that of the mesh {meshed} and as "
    "wide: mesh the section of the body (object.cylinder_m or box_m)",
    "mesh-mirrored": "the mesh is a mirror image of the body, along its {axis} axis: compare it "
    "with the real body",
    "rest-shape": "the mesh is the shape of the body under its weight, with gravity along "
    "({down}) of the mesh, not a stress-free one: state object.rest_shape",
    "several": "a correction of the description brings the residuals to the noise, but the data "
    "do not tell which: {causes}",
    "insufficient": "no single correction of the description brings the residuals to the noise; "
    "these reduce them most: {causes}",
    "tracks-filtered": "the tracks have hardly any noise above {frequency_hz:.2g} Hz "
    "({percent:.2g} % of sigma_m above twice this frequency), as after a low-pass filter, which "
    "changes the motion too: export the tracks without filtering",
    "sensor-filtered": "{what} has hardly any noise above {frequency_hz:.2g} Hz ({percent:.2g} % "
    "of {stated} above twice this frequency), as after a low-pass filter, which changes the "
    "signal too: export its values without filtering",
    "markers-same": "the tracks of markers {first} and {second} are {by_mm:.2g} mm (RMS) apart, "
    "but these markers are at different places of the body: one track is a copy of the other; "
    "correct markers.labels, or omit one of them",
    "sensor-sign": "its values fit with the opposite sign: multiply them by -1, or reverse the "
    "direction of the sensor in its description",
    "sensor-unit": "its values fit if multiplied by {factor:.4g}: check the unit of its columns",
    "sensor-axes": "its axes are exchanged or reversed: its values fit with ({axes}) in place of "
    "(x, y, z); reorder the columns, or rotate the axes",
    "sensor-zero": "its zero is wrong: its values fit if {offset} is subtracted; zero the sensor "
    "before the recording, or estimate the offset",
    "sensor-clock": "it was measured about {by_ms:.3g} ms {when} than its times t_s state: its "
    "clock differs from that of the poses; correct t_s of this sensor",
    "marker-held": "marker {marker} is exactly at one place in {count} samples, from t = "
    "{t_s:.4g} s on, while another moves by {by_mm:.2g} mm: they are no measurements but a gap "
    "that was filled; leave their cells blank",
    "marker-slip": "marker {marker} slips at about t = {t_s:.4g} s: give it markers.weights = 0, "
    "or end window_s before",
    "marker-slip/alone": "marker {marker} slips by {by_mm:.2g} mm at t = {t_s:.4g} s, the others "
    "do not: give it markers.weights = 0, or end window_s before",
    "pose-jump": "the poses jump by {by_mm:.2g} mm at t = {t_s:.4g} s and the markers do not: "
    "repair the poses there, or end window_s before",
    "markers-jump": "all markers jump by {by_mm:.3g} mm at t = {t_s:.4g} s and the poses do not, "
    "which a grasped body cannot do: a simulation may have failed and restarted, or the file "
    "holds two recordings; end window_s before",
    "markers-axes": "the markers fit with ({axes}) in place of (x, y, z): the axes in their file "
    "are exchanged or reversed; reorder the columns, or rotate the tracks",
    "poses-constant": "the markers move by {by_mm:.3g} mm, but the poses are constant and "
    "nothing else drives the body, which starts at rest: check the file and the columns of "
    "grasp.poses, and whether they are those of this recording",
    "not-at-rest": "the markers move by {by_mm:.2g} mm (RMS) within the first {within_ms:.3g} "
    "ms, in which the grasp moves by {grasp_mm:.2g} mm: the body was not at rest at the "
    'beginning, as start = "equilibrium" assumes, or the clocks of markers and poses differ; '
    "begin window_s, or the recording, when the body is at rest",
    "mesh-parts": "the mesh consists of {parts} unconnected parts, and no grasp holds {loose} of "
    "them, the largest with {nodes} nodes: merge coincident nodes, or remove loose parts from "
    "the mesh",
    "obstacle-normal": "obstacle '{obstacle}' contains {percent:.0f} % of the undeformed body at "
    "the first sample, and none of it with the opposite normal: reverse the normal, which points "
    "out of the solid towards the body",
    "specimen-true-stress": "its stresses fit as true stresses (force over deformed area): set "
    'stress = "true", or divide the forces by the undeformed area',
    "specimen-compression": "its strains and stresses fit as those of a compression test: set "
    "strain_sign = -1 and stress_sign = -1",
    "specimen-compression/widening": "its strains and stresses fit as those of a compression "
    "test whose lateral strains are positive where the specimen becomes wider: set strain_sign = "
    "-1 and stress_sign = -1, and multiply the lateral strains in the file by -1",
    "specimen-percent": 'its strains fit as percent: name the unit in the column, "strain (%)"',
    "specimen-kind": "its curve fits as that of a {test} test, with the same law: check the kind "
    "of test; if it is right, compare laws with compare-models --materials",
    "specimen-kind/likelier": "the curve fits better as that of another kind of test, with the "
    "same law: {kinds}, instead of {stated} ({young}): check the kind of test",
    "specimen-moduli": "its moduli fit if storage and loss modulus are exchanged: check which "
    "column is which",
    "specimen-placeholder": "its {quantity} is zero in all rows, and the rest fits better "
    "without it: leave the column out if this was not measured",
    "specimen-area": "its stresses agree with those of the other specimens if they are "
    "multiplied by {factor:.4g}, or the others divided by it, which is the factor of {mistake}: "
    "check area and load of both",
    "specimen-unit": "its stresses fit if multiplied by {factor:g}: the unit of the column is "
    "probably {unit}",
    "wrench-sign": "it fits with the opposite sign: it is the force of the body on the grasp "
    "instead of that of the grasp on the body; set sign = -1 in the table of the wrench",
    "wrench-sign/part": "its {what} fit with the opposite sign, the other components do not: "
    "change the sign of these columns",
    "wrench-axes": "its axes are exchanged or reversed: it fits with ({axes}) in place of (x, y, "
    "z), both forces and torques; reorder the columns, rotate the sensor's axes, or for a log "
    "state sensor_frame in the table of the wrench",
    "wrench-gain": "its {what} fit if multiplied by {factor:.3g}: check the calibration of the "
    "sensor, and the density or mass of the body",
    "wrench-point": "its torques refer to a point {by_mm:.3g} mm away from point_m: set point_m "
    "= {point}, with which they fit",
    "wrench-frame": 'it is expressed in the frame of the {other}: set frame = "{other}"',
    "wrench-unit": "its {what} seem to be in {unit}: multiply them by {factor:g}",
    "wrench-clock": "it was measured about {by_ms:.3g} ms {when} than its times t_s state: its "
    "clock differs from that of the poses; correct t_s of the wrench, or estimate the difference "
    "with nuisance.sensor_time",
    "wrench-tare": "the sensor was probably zeroed while it carried the body: zero it before the "
    "grasp, or widen nuisance.tare",
    "sign": "along {axis} the displacement of grasp {grasp} and its force on the body have "
    "opposite signs (correlation {correlation:.2f}), as if the body produced energy: one of the "
    "signs is wrong; set sign = -1 for the displacement or for the wrench",
    "wrench-offset": "most of its deviation from the simulation at the guess{after} is an "
    "offset, in {component} {offset} ({deviations:.3g} standard deviations of its noise): zero "
    "the sensor before the grasp or subtract a reading without the body; or state nuisance.tare "
    "= {{ prior_sigmas = {prior} }}, and nuisance.tool if a gripper hangs between sensor and body",
    "obstacle-pull": "its force pulls at the body with {pull_n:.3g} N, in {samples} of "
    "{of_samples} samples, which contact without adhesion cannot do: its sign is wrong, or it "
    "was zeroed during the contact; set sign = -1, or zero the load before the contact",
    "obstacle-friction": "its force is up to {ratio:.2g} times as large along the plane as along "
    "the normal, and its friction is stated as {stated:.2g}: correct friction, or estimate it as "
    "a parameter",
    "obstacle-fixed": "its load changes by {change_n:.3g} N, although neither it nor a grasp "
    "moves: check its poses or displacement",
    "obstacle-stroke": "it moves by {stroke_m:.3g} m, the body is {size_m:.3g} m large: check "
    "the unit of its displacement or poses, which are in metres",
    "obstacle-load/far": "it has a load although it is up to {by_mm:.3g} mm away from the "
    "undeformed body: check its place, its size, and the axis, sign and unit of its motion",
    "obstacle-load/deep": "it has no load although it is up to {by_mm:.3g} mm inside the "
    "undeformed body: check its place, its size, and the axis, sign and unit of its motion",
    "obstacle-load/never": "it has a load although it never presses on the undeformed body, "
    "along which it moves by {by_mm:.3g} mm: check the axis of its motion, and its place",
    "camera": "only {percent:.0f} % of the body's visible surface have measured points within "
    "{within_mm:.3g} mm: check camera.pose (camera frame: x to the right, y down, z forward) and "
    "the unit of the depth; check draws a picture of both",
    "camera/likely": "hardly any points are near the body; they would be if {mistakes}",
    "camera-image": "the points fit with rows and columns of the image read {order}: the image "
    "was flipped or rotated after the camera took it; undo that, or describe the camera as it "
    "took the image",
    "camera-matrix/focal": "the points fit with focal lengths {factor:g} times as large: check "
    "fx and fy of camera.matrix, which are in pixels of these images",
    "camera-matrix/centre": "the points fit with the principal point {centre}, {how}: state cx "
    "and cy of camera.matrix from the upper left corner, cx along the columns",
    "camera-rays": "the points fit if the depths are distances along the rays: convert them to "
    "depths along the optical axis, dividing by the length of K⁻¹ (u, v, 1)",
    "camera-pose": "the points fit only if the camera is turned by {degrees:.2g}° and shifted by "
    "{by_mm:.2g} mm, {deviations:.2g} standard deviations of its prior: measure camera.pose "
    "again, or state nuisance.depth_pose",
    "camera-clock": "its images fit {by_ms:.3g} ms away from their times: its clock is {when} "
    "relative to that of the poses; {do} its times",
    "camera-order": "its images fit in reverse order: sort their files by time",
    "camera-constant": "all its images show the same moment, although the body moves by "
    "{by_mm:.3g} mm: check that the images are those of this recording",
    "image-tracks": "the points appear {distance_px:.3g} pixels (median) from where the body is, "
    "which is {size_px:.3g} pixels large in the image: check camera.pose (x to the right, y "
    "down, z forward, in metres), the calibration, places_m and start_s",
    "image-tracks/likely": "the points are not where the body appears ({distance_px:.3g} pixels "
    "off, median), but {nearer:.2g} times nearer if {mistake}",
    "image-tracks/hidden": "{hidden} of {count} points with places_m are on sides of the body "
    "that the camera does not see{remedy}",
    "image-tracks/missing": "images are missing ({count}, the first before {t_s:.4g} s): there "
    "all points move two or three times as far as before and after; state the time of each image "
    "in t_s, as the video has them, not a frame rate",
    "image-tracks/motion": "near the grasp the points do not move as the grasp does (deviation "
    "{unlike:.2g} of its motion), but {nearer:.2g} times more alike if {mistake}",
    "image-track/exchanged": "the tracks {first} and {second} fit each other's places: their "
    "names are exchanged",
    "image-track/stuck": "the track {point} hardly moves where the body moves {predicted_px:.3g} "
    "pixels: the tracker follows the background or is stuck; leave it out with points",
    "image-track/jumps": "the track {point} jumps by {jump_px:.3g} pixels at {t_s:.4g} s: the "
    "tracker has lost the point; delete the samples after it",
    "image-track/off-body": "the estimated place of the track {point} is {off_mm:.3g} mm beyond "
    "the end of a side of the body, so that this is a wrong solution: state places_m of some "
    "points, or a more accurate pose of the camera",
    "image-track/drifts": "the track {point} deviates by {sigmas:.2g} sigma_px (RMS), the others "
    "by {others:.2g}: the tracker has lost the point, or it is not on the body; leave it out "
    "with points",
    "outlines": "the mask at {t_s:.4g} s shows {common:.0%} of where the body is ({mask_px} "
    "pixels, the body {body_px}): check camera.pose (x to the right, y down, z forward, in "
    "metres), the calibration, and that the mask is one of the body",
}
