# SPDX-License-Identifier: Apache-2.0
"""
What every cloud of virtual machines needs; a cloud supplies an adapter.

In reading order: ``options`` (of every virtual machine), ``host_key`` and ``user_data`` (the
boot), ``metadata`` (a cloud's metadata service, read on the machine), ``address`` (the robot's
public address), ``labels`` (tags by a cloud's character rules), ``regions`` (distances), ``cloud``
(the adapter that a cloud implements), ``failures`` (errors of clouds that give a code),
``account`` (retries), ``images`` (ids and tags), ``rest`` (requests to a REST API), ``creation``
(fail-over over regions, types and zones), ``provider`` (the Provider).
"""
