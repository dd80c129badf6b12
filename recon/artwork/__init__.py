"""What a laboratory takes to its rig: patterns for the projector, boards and targets for the printer."""
