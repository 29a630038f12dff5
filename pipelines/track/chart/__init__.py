"""The face laid flat: what its pictures show at each place of the mesh, and what belongs there."""
