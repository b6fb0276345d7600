"""jaxsid: from measured records of a mechanical system to its modes and its mass, damping and stiffness."""
