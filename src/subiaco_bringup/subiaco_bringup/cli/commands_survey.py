"""Verbs that make surveys and maps: simulate, inspect, import, calibrate-rig, map, check, trajectory."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from subiaco_bringup.cli.map_verdict import end_with_verdict
from subiaco_bringup.cli.options import (
    AsJson,
    ConfigFiles,
    Output,
    Overwrite,
    Quiet,
    Settings,
    Verbose,
    print_json,
    say,
    set_up_logging,
)
from subiaco_bringup.cli.progress import Progress
from subiaco_bringup.defaults import config_files
from subiaco_geo.config import load_config
from subiaco_geo.errors import InputError


def _options(named: Mapping[str, tuple[str, object]]) -> dict[str, str]:
    """Return the settings that options make, where given, by the words typed.

    ``named``: the setting and the value of every option.
    """
    given = {option: setting for option, setting in named.items() if setting[1] is not None}
    return {
        option if value is True else f"{option} {value}": f"{key}={'true' if value is True else value}"
        for option, (key, value) in given.items()
    }


def _whole(path: Path | None) -> Path | None:
    """Return an absolute path, for a setting that another process may read."""
    return None if path is None else path.resolve()


def simulate(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Survey directory to write.")],
    seed: Annotated[
        int | None,
        typer.Option(help="Seed of scene, changes and noise; equal seeds give equal surveys."),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            help="Scene: easy (one street, as shipped), default (round a block), "
            "hard (a hillside road with faults), city (20 loops), suburb or dense (a street that the seed "
            "draws), suburb_hard or dense_hard (the same on steep land, two different sensors)."
        ),
    ] = None,
    epoch: Annotated[str | None, typer.Option(help="Which drive to simulate: before, after or both.")] = None,
    maps_only: Annotated[
        bool, typer.Option("--maps-only", help="Write fused maps with truth instead of bags.")
    ] = False,
    duration: Annotated[float | None, typer.Option(help="Length of each drive in seconds.")] = None,
    mode: Annotated[
        str | None, typer.Option(help="LiDAR columns x turns a second: 512x10, 1024x10 or 2048x10.")
    ] = None,
    config: ConfigFiles = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Simulate a survey of two epochs with known changes: bags and truth.

    Example: subiaco simulate bags/demo --preset easy --seed 1 --duration 20
    """
    from subiaco_sim.config import SimulationConfig
    from subiaco_sim.survey import simulate as simulate_survey

    set_up_logging(verbose, quiet)
    options = _options(
        {
            "--seed": ("seed", seed),
            "--preset": ("preset", preset),
            "--epoch": ("epoch", epoch),
            "--duration": ("duration", duration),
            "--mode": ("mode", mode),
            "--maps-only": ("maps_only", maps_only or None),
        }
    )
    files = config_files("simulation", tuple(config or ()))
    model = load_config(SimulationConfig, files, settings or [], options)
    with Progress(quiet=quiet) as progress:
        simulate_survey(out, model, progress, overwrite=overwrite)
    say(f"simulated survey: {out}", quiet=quiet)


def inspect(
    bag: Annotated[
        Path, typer.Argument(metavar="BAG", help="rosbag2 folder, .mcap file or simulated epoch folder.")
    ],
    config: ConfigFiles = None,
    settings: Settings = None,
    as_json: AsJson = False,
    verbose: Verbose = False,
) -> None:
    """Say whether a bag is usable, and why not: topics, rates, losses, clocks, RTK states, IMU.

    Ends with 0 where it is usable, with or without care, and with 2 where it is not.

    Topics of other names are recognised by their types, or named by the configuration.

    Example: subiaco inspect bags/demo/before
    """
    from subiaco_mapping.config import MappingConfig
    from subiaco_mapping.inspection.inspect_bag import describe, inspect_bag

    set_up_logging(verbose, quiet=False)
    model = load_config(MappingConfig, config_files("mapping", tuple(config or ())), settings or [])
    facts = inspect_bag(bag, model)
    if as_json:
        print_json(facts)
    else:
        typer.echo(describe(facts))
    if facts["forbids"]:
        raise typer.Exit(2)


def import_(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDING",
            help="Raw Ouster packets: .pcap with its .json, .osf, or ROS 1 .bag; or a raw folder of KITTI.",
        ),
    ],
    output: Output,
    metadata: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Ouster metadata JSON; without it, the one beside the pcap of the same name."
        ),
    ] = None,
    gnss: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Fixes (and headings): CSV with UTC stamps, see logs.gnss; or a solution of RTKLIB (.pos).",
        ),
    ] = None,
    imu: Annotated[
        Path | None, typer.Option(metavar="CSV", help="IMU samples with UTC stamps; see logs.imu.")
    ] = None,
    config: ConfigFiles = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Convert a recording into an mcap bag that every other verb reads.

    Columns of other names: --set logs.gnss.latitude=lat, and so on.

    Example: subiaco import drive.pcap --gnss gnss.csv --imu imu.csv -o bags/drive
    """
    from subiaco_mapping.config import MappingConfig
    from subiaco_mapping.importers.csv_logs import read_gnss_log, read_imu_log
    from subiaco_mapping.importers.packets import import_recording

    set_up_logging(verbose, quiet)
    logs = load_config(MappingConfig, config_files("mapping", tuple(config or ())), settings or []).logs
    fixes = [] if gnss is None else read_gnss_log(gnss, logs)
    samples = [] if imu is None else read_imu_log(imu, logs)
    logged = sorted(fixes + samples, key=lambda message: message.time_ns)
    counts = import_recording(recording, output, metadata=metadata, logged=logged, overwrite=overwrite)
    listed = ", ".join(f"{count} on {topic}" for topic, count in counts.items())
    say(f"bag: {output} ({listed})", quiet=quiet)


def map_(
    bags: Annotated[
        list[Path],
        typer.Argument(
            metavar="BAG",
            help="One or more bags of one epoch, each a drive: rosbag2 folder, .mcap or simulated epoch.",
        ),
    ],
    output: Output,
    control: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            help="Surveyed control points that constrain the map; one in three is held out as a check. "
            "Columns and settings: control.*.",
        ),
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            metavar="CLOUD",
            help="Map or cloud of known position (airborne, terrestrial, an earlier epoch) that holds "
            "the map where GNSS is poor; settings: reference.*.",
        ),
    ] = None,
    config: ConfigFiles = None,
    settings: Settings = None,
    threads: Annotated[
        int | None, typer.Option(help="Number of threads; with 1, the map is identical in every run.")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1, help="Number of recordings read in parallel [all cores]. Does not change the map."
        ),
    ] = None,
    resume: Annotated[
        bool | None,
        typer.Option(
            "--resume/--no-resume",
            show_default=False,
            help="Use the recordings that a stopped run on the same MAP_DIR had finished (default), or start "
            "over. With --resume, a finished map is no error.",
        ),
    ] = None,
    keep_checkpoint: Annotated[
        bool,
        typer.Option(
            "--keep-checkpoint",
            help="Leave the checkpoint: with --overwrite and other settings for what follows the odometry, "
            "recordings are not read again.",
        ),
    ] = False,
    full_density: Annotated[
        bool,
        typer.Option(
            "--full-density",
            help="Write every return too: classified LAZ tiles with GPS times in MAP_DIR/full_density. "
            "map.laz has one point for each voxel of 0.25 m.",
        ),
    ] = False,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Build one georeferenced map from the bags of one epoch.

    A bag without usable GNSS fixes gives a map in a local frame, without CRS.
    A map that most of its own fixes contradict is written, flagged and ends with 3.
    Residuals at control and check points are in quality.html and map.yaml.
    Until the map is written, the work lies beside it in .MAP_DIR.checkpoint.

    Example: subiaco map bags/demo/before -o out/before
    """
    from subiaco_change.segmentation.classes import map_classes
    from subiaco_mapping.config import MappingConfig
    from subiaco_mapping.job import run_mapping
    from subiaco_mapping.request import MappingRequest

    set_up_logging(verbose, quiet)
    if resume and not overwrite and (output / "map.yaml").is_file():
        say(f"map: {output} is finished; nothing to resume", quiet=quiet)
        return
    files = config_files("mapping", tuple(config or ()))
    options = _options(
        {
            "--control": ("control.file", _whole(control)),
            "--reference": ("reference.cloud", _whole(reference)),
            "--threads": ("threads", threads),
            "--full-density": ("fusion.full_density", full_density or None),
        }
    )
    request = MappingRequest.of(
        bags=tuple(bags), output=output, workers=workers or os.cpu_count() or 1,
        resume=resume is not False, keep_checkpoint=keep_checkpoint, overwrite=overwrite,
        config=load_config(MappingConfig, files, settings or [], options),
    )  # fmt: skip
    with Progress(quiet=quiet) as progress:
        survey = run_mapping(request, progress, map_classes)
    place = survey.cloud.crs or "a local frame without CRS"
    say(f"map: {output} ({len(survey.cloud):,} points in {place})", quiet=quiet)
    end_with_verdict(output, quiet=quiet)


def check(
    survey: Annotated[Path, typer.Argument(metavar="MAP", help="Map directory, or a cloud with a CRS.")],
    control: Annotated[
        Path,
        typer.Option(
            metavar="CSV",
            help="name,east,north,height (ellipsoidal, or see --geoid) and, where somebody picked the points "
            "in the map, map_east,map_north,map_height.",
        ),
    ],
    crs: Annotated[
        str | None,
        typer.Option(metavar="EPSG:N", help="CRS of the control points [that of the map]."),
    ] = None,
    geoid: Annotated[
        Path | None,
        typer.Option(
            metavar="GRID",
            help="Geoid model (.gtx, .tif) of the heights of the control points (AUSGeoid2020 for AHD).",
        ),
    ] = None,
    as_json: AsJson = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Compare a map with surveyed control points: residuals and RMSE.

    Example: subiaco check out/before --control points.csv
    """
    from subiaco_geo.maps import load_epoch
    from subiaco_mapping.control import check_control, describe_control
    from subiaco_mapping.control_points import read_control

    set_up_logging(verbose, quiet)
    cloud = load_epoch(survey).cloud
    if cloud.crs is None:
        raise InputError(f"{survey}: the map has no CRS, so control points cannot be placed in it")
    residuals = check_control(cloud, read_control(control, cloud.crs, crs, geoid))
    if as_json:
        print_json(residuals.summary())
    else:
        typer.echo(describe_control(residuals))


def calibrate_rig(
    bag: Annotated[
        Path,
        typer.Argument(
            metavar="BAG",
            help="Recording of one to three minutes with turns in both directions and changes of speed.",
        ),
    ],
    output: Output,
    config: ConfigFiles = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Estimate the positions of IMU and antenna and their time offsets from a short recording.

    Starts from /tf_static and the configuration, keeps values that the motion does not determine, and says
    whether facades come out thinner. Writes rig.yaml for --config, report.md, calibration.json.

    Example: subiaco calibrate-rig bags/turns -o out/rig
    """
    from subiaco_geo.atomic import refuse_existing, refuse_foreign
    from subiaco_mapping.calibration import report
    from subiaco_mapping.calibration.rig import calibrate_rig as calibrate
    from subiaco_mapping.config import MappingConfig

    set_up_logging(verbose, quiet)
    refuse_existing(output, overwrite)
    refuse_foreign(output, report.MARKER)
    model = load_config(MappingConfig, config_files("mapping", tuple(config or ())), settings or [])
    with Progress(quiet=quiet) as progress:
        found = calibrate(bag, model, progress)
    report.write_calibration(output, found, model, bag.name, overwrite=overwrite)
    say(f"rig: {output / report.MARKER} (facades {found.facades.verdict}; see report.md)", quiet=quiet)


def trajectory(
    estimate: Annotated[Path, typer.Argument(metavar="ESTIMATE", help="Trajectory to evaluate, a TUM file.")],
    reference: Annotated[Path, typer.Argument(metavar="REFERENCE", help="Reference trajectory, a TUM file.")],
    output: Output,
    align: Annotated[
        bool, typer.Option("--align", help="Move the estimate rigidly onto the reference first.")
    ] = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Compare two trajectories: absolute and relative errors, a table and plots.

    Both are taken as they are, so that an offset is an error too, unless --align is given.

    Example: subiaco trajectory out/before/trajectory.tum surveyed.tum -o out/compared
    """
    from subiaco_geo.atomic import refuse_existing
    from subiaco_geo.trajectories import read_tum
    from subiaco_mapping.map_quality.trajectory_comparison import compare, table, write_comparison

    set_up_logging(verbose, quiet)
    refuse_existing(output, overwrite)
    found = compare(read_tum(estimate), read_tum(reference), align=align)
    write_comparison(output, found, overwrite=overwrite)
    if as_json:
        print_json(found.described())
    else:
        typer.echo(table(found.described()), nl=False)
    say(f"comparison: {output}", quiet=quiet)


def register(app: typer.Typer) -> None:
    """Add these verbs to the command."""
    app.command("simulate", short_help="Simulate a survey of two epochs, with truth.")(simulate)
    app.command("inspect", short_help="Say what a bag holds before you trust it.")(inspect)
    app.command("import", short_help="Turn a recording of raw packets into a bag.")(import_)
    app.command("map", short_help="Build one georeferenced map from bags.")(map_)
    app.command("calibrate-rig", short_help="Refine extrinsics and clocks from a short drive.")(calibrate_rig)
    app.command("check", short_help="Compare a map with surveyed control points.")(check)
    app.command("trajectory", short_help="Compare two trajectories: errors and plots.")(trajectory)
