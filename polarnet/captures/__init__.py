"""The division-of-time rig (paper, section 4): eight captures of a target, brought onto one clock."""
