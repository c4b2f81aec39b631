"""What an error model leaves out: the detector itself in the closed loop, where truth is counted.

``python -m studies.detector_in_the_loop`` renders what a camera behind the windscreen sees, has a
small convolutional detector look at it, and lets the ego of pemviz's own scenarios act on what was
detected. Beside that stands what a user of pemviz gets from labelled frames of the same detector:
``pem collect``, ``pem fit``, ``pem check`` and ``record``. ``README.md`` has the table.
"""
