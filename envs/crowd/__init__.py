"""The environments of a robot among several humans: settings, controllers, pictures.

``import ms_highway`` registers the ids ``ms-highway/dense-merge-v0`` and ``ms-highway/crossing-crowd-v0``. Imports what
`ms_highway.envs` does.
"""
