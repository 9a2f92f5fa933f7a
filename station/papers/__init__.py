"""The numbers of the four papers, computed; their errata; the functions for their equations."""
