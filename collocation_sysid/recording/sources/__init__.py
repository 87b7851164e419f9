"""Sources of recordings, files and topics of logs; they are used through `recording.marker_files`,
`pose_files` and `time_tables`.

- `source`: the table or the content of a path, whether it names a file or a topic; `text`, `columns`,
  `units`: tables, columns recognised by name, units.
- `raw_tracks`: marker tracks as they are in a file; `c3d`, `trc`, `qualisys`, `motive` and
  `plain_csv` read the formats.
- `logs`: logs of robots (ROS bags, MCAP, LeRobot); `messages`: the numbers in their messages;
  `topics`: the tables of topics; `log_frames`: transforms between frames.
- `depth_files`, `camera_messages`, `ply`: depth images and clouds of points, `calibration_files`:
  cameras, from files and logs.
"""
