"""The library under the notebooks: scene, camera, encoder, messages, learners, statistics and figures."""
