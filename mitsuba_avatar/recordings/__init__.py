"""Motion and faces that other systems recorded: BVH retargeted onto the rig, Live Link Face."""
