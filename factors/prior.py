"""The prior on the root vertex: what fixes the joint frame (M1)."""

import gtsam
import numpy as np

from factors.noise import FloatArray, check_covariance, check_pose

# The root is where it is by definition: 0.1 mm and 0.006 deg, tight against any measurement, yet solved well.
ROOT_COVARIANCE: FloatArray = check_covariance(np.diag([1e-8, 1e-8, 1e-8]), "root prior")


def prior_factor(key: int, pose: gtsam.Pose2, covariance: FloatArray = ROOT_COVARIANCE) -> gtsam.PriorFactorPose2:
    """Vertex ``key`` is at ``pose`` (joint_T_vertex); (3, 3) ``covariance`` in the frame of the vertex.

    Raises:
        FactorError: if the pose is not finite or the covariance not positive definite.
    """
    noise = gtsam.noiseModel.Gaussian.Covariance(check_covariance(covariance, "prior"))
    return gtsam.PriorFactorPose2(key, check_pose(pose, "prior"), noise)
