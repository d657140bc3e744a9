"""What a robot drives by: `floor` finds the ground, `grid_evidence` what one view says of the cells, `grid` decides, `planner` finds a path.

For planning besides: costs, rooms, reach, flight. For people: `floor_plan` with its walls and rooms.
"""
