"""How a scenario is played: the story of a mission, and the backends that tell it, by programs or in virtual time."""
