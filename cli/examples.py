"""Examples that ``--help`` and the documentation show; the tests run them, in this order, in one folder."""

EXAMPLES: dict[str, tuple[str, ...]] = {
    "sample": ("turbrestore sample sample_data --overwrite",),
    "info": ("turbrestore info sample_data/chart.mkv", "turbrestore info sample_data/chart.mkv --quality"),
    "app": ("turbrestore app sample_data/chart.mkv", "turbrestore app --allow results --port 8123 --no-browser"),
    "config": ("turbrestore config --init run.toml", "turbrestore config --check run.toml"),
    "restore": (
        "turbrestore restore sample_data/chart.mkv sharp.png",
        "turbrestore restore sample_data/chart.mkv part.png --roi 64,32,96,96",
        "turbrestore restore sample_data/chart.mkv quick.png --preset fast",
        "turbrestore restore sample_data/chart.mkv again.png --config sharp.png.toml",
        "turbrestore restore sample_data/chart.mkv all.png --keep stages --truth sample_data/chart_truth.png --json",
        "turbrestore restore sample_data/chart.mkv later.png --keep kept --resume",
    ),
    "register": (
        "turbrestore register sample_data/chart.mkv registered.ser",
        "turbrestore register sample_data/chart.mkv frames.tif --flows flows.npz --bit-depth 16",
    ),
    "steady": (
        "turbrestore steady sample_data/chart.mkv steady.mp4",
        "turbrestore steady sample_data/chart.mkv still.mkv --camera lock --mask moving.mkv --json",
    ),
    "batch": (
        "turbrestore batch sample_data/chart.mkv results",
        "turbrestore batch sample_data 'sample_data/*.mkv' results --resume",
    ),
    "align": (
        "turbrestore align sharp.png quick.png aligned",
        "turbrestore align sharp.png quick.png onto --onto sharp.png",
        "turbrestore align --rgb sharp.png quick.png again.png colour",
    ),
    "report": ("turbrestore report stages", "turbrestore report stages report.html"),
    "seeing": (
        "turbrestore seeing sample_data/chart.mkv",
        "turbrestore seeing sample_data/chart.mkv --pixel-scale 2.75e-6 --aperture 0.1 --distance 2000 --json",
    ),
    "centroid": ("turbrestore centroid sample_data/chart.mkv centroid.npz --train 40",),
    "flow": ("turbrestore flow centroid.npz sample_data/chart.mkv flows.npy --flow.method farneback",),
    "identify": (
        "turbrestore identify centroid.npz dynamics.npz",
        "turbrestore identify centroid.npz other.npz --plot prediction.png --dynamics.rank 20",
    ),
    "predict": ("turbrestore predict sample_data/chart.mkv centroid.npz dynamics.npz predicted.png",),
    "filter": ("turbrestore filter sample_data/chart.mkv centroid.npz dynamics.npz filtered.npz",),
    "deconvolve": (
        "turbrestore deconvolve stages --sweep 1,1.4,2",
        "turbrestore deconvolve filtered.npz deblurred.png --guide centroid.npz",
        "turbrestore deconvolve filtered.npz tv.png --sigma 1.2 --deconvolution.method tv",
    ),
    "evaluate": (
        "turbrestore evaluate sharp.png sample_data/chart_truth.png --clip sample_data/chart.mkv",
        "turbrestore evaluate sharp.png --reference stages/mean.png --json",
    ),
    "synthesize": (
        "turbrestore synthesize chart haze.mkv --strength medium --frames 120 --seed 1",
        "turbrestore synthesize camera more.mkv --model dynamic-texture --like sample_data/chart.mkv --frames 300",
    ),
    "moments wavefront": ("turbrestore moments wavefront --seeds 20",),
    "moments mirror": ("turbrestore moments mirror --seeds 20 --deviation 3 --json",),
    "doctor": ("turbrestore doctor", "turbrestore doctor --json"),
    "--install-completion": (
        "turbrestore --install-completion --yes",
        "turbrestore --install-completion --shell bash --output turbrestore.bash",
    ),
}
FIRST_STEPS = (
    "turbrestore sample sample_data",
    "turbrestore restore sample_data/chart.mkv sharp.png --report sharp.html",
    "turbrestore restore --help",
    "turbrestore doctor",
)


def epilogue(commands: tuple[str, ...]) -> str:
    """Commands as a block at the end of a help page."""
    return "\n".join(["Examples:", *(f"  {command}" for command in commands)])
