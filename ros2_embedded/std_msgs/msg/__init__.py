# SPDX-License-Identifier: Apache-2.0
from rosidl_embedded import importer

__getattr__, __dir__ = importer.of(__name__)
