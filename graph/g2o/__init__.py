"""The g2o text format of pose graphs and of graphs with landmarks."""
