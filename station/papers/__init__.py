"""The numbers of the four papers, computed: what is reproduced, what is an error, what is built where."""
