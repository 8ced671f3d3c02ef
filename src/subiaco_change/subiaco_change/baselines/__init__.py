"""The simple methods people use today, writing the same products, to be measured beside ours."""
