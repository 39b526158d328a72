"""How far the gap in the *task* shrinks: a policy in the simulator, in another simulator, in the corrected simulator."""
