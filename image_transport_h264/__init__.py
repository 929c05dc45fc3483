# SPDX-License-Identifier: Apache-2.0
"""
Transport images as H.264, by a codec without ROS and two nodes.

``cdr`` reads and writes serialized messages, also for other packages. ``annexb`` parses H.264
streams, ``picture`` describes images, ``settings`` the encoder's settings. ``deep`` codes deep
images, ``codec`` all others, ``stills`` JPEG and PNG. ``worker`` runs work in a thread. ``pacing``
limits images in flight, ``rate`` estimates a link, ``control`` adapts the encoder to all links,
``repair`` corrects losses, ``memory`` keeps freed memory. ``acknowledgement`` waits for readers.
``ending`` runs a node until a signal. ``sharing`` divides the bandwidth of a link among streams.
``message`` converts ROS messages, ``lazy`` is the base of both nodes, ``slices`` sends large
images in slices, ``budget`` keeps a stream within its share. ``receivers`` and ``senders`` do
their work by codec, for the nodes ``decoder`` and ``encoder``.
"""
