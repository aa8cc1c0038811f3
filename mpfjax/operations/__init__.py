"""The inner operations of every filter, in the forms that XLA runs fast, behind plain names.

If you read the code for the papers, skip this floor. Each file names the line of numpy that it
stands for, and then explains its form.
"""
