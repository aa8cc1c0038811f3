"""The inner operations of every filter, in the forms that XLA runs fast, behind plain names.

Who reads for the papers can skip this floor: each file says which line of numpy it stands for, and
only then why it is written as it is.
"""
