"""ROS 2 nodes around ``uncertain_lti``: parameters, QoS, clocks and messages; no numerics of their own."""
