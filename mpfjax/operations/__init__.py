"""The inner operations of every filter, in the forms that XLA runs fast, behind plain names.

If you read the code for the papers, skip this floor. Each file first says which line of numpy it
stands for, and then why it is written as it is.
"""
