"""Import of quadrupeds: `reader` reads any URDF or MJCF with MuJoCo's parsers, `writer` writes a robot's folder."""
