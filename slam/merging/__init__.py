"""Maps of several finished runs made one."""
