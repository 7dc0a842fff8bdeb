"""The whole way from recordings to a dataset, with pictures to check it by."""
