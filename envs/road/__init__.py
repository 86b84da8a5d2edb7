"""Drive the stock environments of highway-env: a wrapper, a policy, and what they need to know of each scene.

May import `ms_highway.vehicle` and what stands below it.
"""
