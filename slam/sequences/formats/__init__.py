"""Layouts of recordings other than TUM's, recognised by what lies in the folder."""
