"""Hold rewards and drivers learned from recordings, and the data files.

`learned_reward` is a reward with its provenance, `learned_drivers` describes how real
drivers drive seconds ahead. `ms_highway.irl` learns both, and everything above
`ms_highway.game` may read them. Imports `ms_highway.game` and what stands below it.
"""
