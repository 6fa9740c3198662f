"""Print the words that RapidOCR reads in images, one list in JSON a line; their own environment runs this file.

    python reader_child.py

takes the paths of images, one a line, from its standard input.
"""

import json
import sys


def run() -> None:
    """Answer until the input ends."""
    from rapidocr_onnxruntime import RapidOCR

    # On busy cores its threads wait for each other: one reads the same words in two thirds of the time.
    reader = RapidOCR(intra_op_num_threads=1)
    for line in sys.stdin:
        lines, _ = reader(line.rstrip("\n"))
        print(json.dumps([word for _, text, _ in lines or () for word in text.split()]), flush=True)


if __name__ == "__main__":
    run()
