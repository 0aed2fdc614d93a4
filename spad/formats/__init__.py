"""Hold and read histograms, timestamps, `.mat` files, captures and RGB-D simulations."""
