"""What was recorded and how an image comes to be: runs, cameras, meshes, rendering, simulation. No gtsam."""
