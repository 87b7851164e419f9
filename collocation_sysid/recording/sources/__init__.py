"""Sources of recordings, files and topics of logs; they are used through `recording.marker_files`,
`pose_files` and `time_tables`.

- `text`, `columns`, `units`: CSV tables, columns recognised by name, units.
- `raw_tracks`: marker tracks as they are in a file; `c3d`, `trc`, `qualisys`, `motive` and
  `plain_csv` read
the formats.
- `logs`, `topics`: logs of robots (ROS bags, MCAP, LeRobot), and the tables in their topics;
  `point_topics`: one marker table from several topics; `log_frames`: static transforms between
  frames.
- `depth_files`, `camera_messages`, `ply`: depth images and clouds of points, from files and logs.
"""
