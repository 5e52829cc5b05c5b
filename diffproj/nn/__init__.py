"""Modules for training: pixels from a network in, points on a plane out, and a loss in world units.

    network -> pixels -> PlaneProjector -> points, valid -> PlaneLoss -> millimetres

Camera and plane can be learned along with the network, whole or in parts, in a `PlaneProjector` or on their own as
`LearnableCamera`, `LearnablePlane` and, for cameras that stand still to each other, `LearnableRig`; `CalibrationPrior`
adds what a calibration knows about the camera to the loss.
Geometry keeps its precision under autocast and when a network is converted to half precision.
"""
