"""SpatialVLA's configuration, taken from the installed package `{{package}}`."""

from {{package}}.configuration_spatialvla import SpatialVLAConfig as _SpatialVLAConfig


class SpatialVLAConfig(_SpatialVLAConfig):
    pass
