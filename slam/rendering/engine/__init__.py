"""The renderer: shapes, textures, light, ray casting, the camera path and the depth sensor."""
