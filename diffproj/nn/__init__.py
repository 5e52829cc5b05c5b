"""Parts for a training pipeline: pixels of a network in, points on a plane out, and a loss in world units.

    network -> pixels -> PlaneProjector -> points, valid -> PlaneLoss -> millimetres

The projector's camera and plane may be learned along, whole or in parts; `CalibrationPrior` keeps them where the
calibration says they are, as firmly as it knows. Geometry runs in the camera's own precision, under autocast too.
"""
