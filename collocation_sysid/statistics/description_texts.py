"""Messages of the likely mistakes, by their codes after "description/"."""

from __future__ import annotations

MESSAGES = {
    "poses-inverted": "the markers move as if the poses were inverted: invert them; a pose must "
    "map the undeformed body to its current position",
    "quaternion-order": "the markers move as if the quaternions were in another order: name their "
    'columns {columns}, in this order, or set grasp.quaternion = "{order}" if they are numbered',
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
    "end-mass": "a mass of about {mass_g:.2g} g hangs at the end and is not stated: weigh it, and state "
    "it in [[experiment.mass]]",
    "sensor-tool": "the force sensor carries about {tool_g:.2g} g besides the body, with which it was "
    "not zeroed: estimate it with nuisance.tool, or zero the sensor with the gripper and its tool",
    "grasp-layer": "the fit is better if the grasp holds one layer of nodes {deep} than stated: "
    "compare the box of grasp.nodes with the ends of the fingers",
    "markers-exchanged": "the names of markers are exchanged: {names}; correct markers.labels or "
    "reference_m",
    "law": "the material deforms by another law than stated, such as {material}: compare laws "
    "with compare-models --materials",
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
    "markers-same": "the tracks of markers {first} and {second} are {by_mm:.2g} mm (RMS) apart, "
    "but these markers are at different places of the body: one track is a copy of the other; "
    "correct markers.labels, or omit one of them",
    "sensor-sign": "its values fit with the opposite sign: multiply them by -1, or reverse the "
    "direction of the sensor in its description; of a wrench, which is that of the grasp on the "
    "body, set sign = -1",
    "sensor-unit": "its {what} fit if multiplied by {factor:.4g}: check the unit of its columns",
    "sensor-axes": "its axes are turned, exchanged or reversed: multiply its rows "
    "(x, y, z) from the right by {axes}",
    "markers-axes": "the markers fit with ({axes}) in place of (x, y, z): the axes in their file "
    "are exchanged or reversed; reorder the columns, or rotate the tracks",
    "not-at-rest": "point {point} of '{experiment}' moves by {by} ({sigmas:.2g} times {noise}) in "
    'the first {still_s:.3g} s, in which the poses stand still, but with start = "equilibrium" the '
    "body is at rest until a grasp moves: wait before the recording until the body is at rest, let "
    'window_s begin when it is, or state start = "moving"',
    "specimen-true-stress": "stresses fit as true stresses (force over deformed area): set "
    'stress = "true", or divide the forces by the undeformed area',
    "specimen-compression": "strains and stresses fit as those of a compression test: set "
    "strain_sign = -1 and stress_sign = -1",
    "specimen-percent": 'strains fit as percent: name the unit in the column, "strain (%)"',
    "specimen-kind": "the curve fits as that of a {test} test, with the same law: check the kind "
    "of test; if it is right, compare laws with compare-models --materials",
    "specimen-kind/likelier": "the curve fits better, with the same law, as {kinds}, instead of "
    "{stated} ({young}): check the kind of test and of stress, and the unit of the strain",
    "specimen-placeholder": "its {quantity} is zero in all rows, and the rest fits better "
    "without it: leave the column out if this was not measured",
    "specimen-area": "its stresses agree with those of the other specimens if they are "
    "multiplied by {factor:.4g}, or the others divided by it, which is the factor of {mistake}: "
    "check area and load of both",
    "sign": "along {axis} the displacement of grasp {grasp} and its force on the body have "
    "opposite signs (correlation {correlation:.2f}), as if the body produced energy: one of the "
    "signs is wrong; set sign = -1 for the displacement or for the wrench",
    "obstacle-pull": "its force pulls at the body with {pull_n:.3g} N, in {samples} of "
    "{of_samples} samples, which contact without adhesion cannot do: its sign or the "
    "normal of a plane is wrong, or it was zeroed during the contact; set sign = -1, reverse the normal, "
    "which points out of the solid towards the body, or zero the load before the contact",
    "camera": "only {percent:.0f} % of the body's visible surface have measured points within "
    "{within_mm:.3g} mm: check camera.pose (camera frame: x to the right, y down, z forward) and "
    "the unit of the depth; check draws a picture of both",
    "camera/likely": "hardly any points are near the body; they would be if {mistakes}",
    "image-tracks": "the points appear {distance_px:.3g} pixels (median) from where the body is, "
    "which is {size_px:.3g} pixels large in the image: check camera.pose (x to the right, y "
    "down, z forward, in metres), the calibration, places_m and start_s",
    "image-tracks/likely": "the points are not where the body appears ({distance_px:.3g} pixels "
    "off, median), but {nearer:.2g} times nearer if {mistake}",
    "image-tracks/hidden": "{hidden} of {count} points with places_m are on sides of the body "
    "that the camera does not see{remedy}",
    "image-tracks/motion": "near the grasp the points do not move as the grasp does (deviation "
    "{unlike:.2g} of its motion), but {nearer:.2g} times more alike if {mistake}",
    "image-track": "the track {point} deviates by {sigmas:.2g} sigma_px (RMS), the others by "
    "{others:.2g}: the tracker has lost the point or is stuck, its name is that of another, or it is "
    "not on the body; leave it out with points",
}
