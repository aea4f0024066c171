"""Normal flow, inverse depth and IMU samples in; velocity with covariance out."""
