"""Objects of the map: detections with depth, association, revision, boxes, gravity."""
