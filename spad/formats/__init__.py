"""Read and write what others use: `.mat` files, captures, dense counts, point clouds and RGB-D simulations."""
