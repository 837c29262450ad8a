"""The library under the notebooks: scene and camera, encoder and messages, learners, statistics and figures."""
