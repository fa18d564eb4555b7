"""Importer of quadrupeds: `reader` parses any URDF or MJCF with MuJoCo, `writer` writes a robot's folder."""
