"""The networks of the learned methods; skipped where PyTorch is not installed."""

from dataclasses import replace

import numpy as np
import pytest

from subiaco_evaluation.learned.config import PointNetworkConfig, RasterNetworkConfig, TrainingConfig
from subiaco_evaluation.learned.features import chosen_features, point_features
from subiaco_evaluation.learned.jobs import TrainingJob
from subiaco_evaluation.learned.kernel_points import kernel_points
from subiaco_evaluation.learned.labels import to_classes
from subiaco_evaluation.learned.pyramids import build_pyramid
from subiaco_evaluation.learned.sampling import cut_pair
from subiaco_evaluation.learned.surveys import PointPair, RasterPair
from subiaco_evaluation.learned.weights_file import SHIPPED, read_record, read_weights, write_weights
from subiaco_geo.codes import Change
from subiaco_geo.errors import InputError

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make learned")

from subiaco_evaluation.learned import training  # noqa: E402
from subiaco_evaluation.learned.batches import Neighbourhood, collate, neighbourhood  # noqa: E402
from subiaco_evaluation.learned.deep_clustering import ClusterTask, spherical_k_means  # noqa: E402
from subiaco_evaluation.learned.kpconv import Bottleneck, KernelPointConvolution, gather  # noqa: E402
from subiaco_evaluation.learned.point_networks import POINT_NETWORKS, difference  # noqa: E402
from subiaco_evaluation.learned.predict import load_network  # noqa: E402
from subiaco_evaluation.learned.raster_networks import RASTER_NETWORKS  # noqa: E402
from subiaco_evaluation.learned.tasks import (  # noqa: E402
    POWERS,
    PointTask,
    RasterTask,
    Validation,
    prior_factors,
    score_validation,
    task_loss,
)
from subiaco_evaluation.learned.training import (  # noqa: E402
    State,
    begin,
    model_arrays,
    read_checkpoint,
    run_epoch,
    train,
    write_checkpoint,
)

TINY = PointNetworkConfig(
    width=8, levels=3, neighbours=10, radius=6.0, kernel_points=9, dropout=0.0, features=(), clusters=12
)
SUPERVISED = ("siamese-kpconv", "triplet-kpconv", "efs-kpconv")


def twin_of_a_convolution(queries, support, features, index, kernel, extent, weight):
    """The same in plain loops."""
    outputs = np.zeros((len(queries), weight.shape[2]))
    for i, row in enumerate(index):
        for j in row[row < len(support)]:
            for k, point in enumerate(kernel):
                away = np.linalg.norm(support[j] - queries[i] - point)
                outputs[i] += max(0.0, 1.0 - away / extent) * features[j] @ weight[k]
    return outputs


def test_the_convolution_equals_its_twin_in_numpy():
    rng = np.random.default_rng(0)
    support, queries = rng.uniform(-1, 1, (20, 3)), rng.uniform(-1, 1, (7, 3))
    features, weight = rng.normal(size=(20, 3)), rng.normal(size=(9, 3, 4))
    index = rng.integers(0, 21, (7, 6))  # 20 is a missing neighbour
    kernel = kernel_points(9, 0.6)
    layer = KernelPointConvolution(9, 3, 4)
    layer.weight.data = torch.from_numpy(weight.reshape(27, 4)).float()
    tensors = [torch.from_numpy(a).float() for a in (queries, support)]
    near = neighbourhood(*tensors, torch.from_numpy(index), torch.from_numpy(kernel).float(), 0.8)
    found = layer(torch.from_numpy(features).float(), near).detach().numpy()
    expected = twin_of_a_convolution(queries, support, features, index, kernel, 0.8, weight)
    assert np.abs(expected).max() > 0.1
    assert np.allclose(found, expected, atol=1e-4)


def test_a_missing_neighbour_has_no_features_and_no_influence():
    features = torch.ones((3, 2))
    index = torch.tensor([[0, 3], [3, 3]])
    assert gather(features, index).sum(dim=(1, 2)).tolist() == [2.0, 0.0]
    near = neighbourhood(torch.zeros((2, 3)), torch.zeros((3, 3)), index, torch.zeros((1, 3)), 1.0)
    assert near.influence[:, 0].tolist() == [[1.0, 0.0], [0.0, 0.0]]


def test_the_difference_is_to_the_features_of_the_nearest_reference_point():
    reference, compared = torch.tensor([[1.0, 0.0], [5.0, 2.0]]), torch.tensor([[6.0, 3.0], [1.0, 1.0]])
    found = difference(reference, compared, torch.tensor([1, 0]))
    assert found.tolist() == [[1.0, 1.0], [0.0, 1.0]]


def test_a_block_whose_inputs_equal_its_outputs_adds_to_them():
    block = Bottleneck(9, 8, 8, 0.1).eval()
    near = Neighbourhood(torch.zeros((4, 1), dtype=torch.int64), torch.zeros((4, 9, 1)))
    features = torch.randn((4, 8))
    block.leave.norm.weight.data.zero_()
    assert torch.allclose(block(features, near), features)


def house_pair():
    """Flat ground, and a box that stands on it in the second epoch alone."""
    rng = np.random.default_rng(5)
    ground = [np.column_stack([rng.uniform(-8, 8, (3000, 2)), np.zeros(3000)]) for _ in range(2)]
    faces = np.column_stack([rng.uniform(-2, 2, (600, 2)), np.full(600, 3.0)])
    clouds = [ground[0], np.concatenate([ground[1], faces])]
    pyramids = tuple(build_pyramid(cloud, TINY) for cloud in clouds)
    classes = tuple((p.levels[0].xyz[:, 2] > 1.0).astype(np.int64) for p in pyramids)
    return PointPair(pyramids, classes)


@pytest.fixture(scope="module")
def batch():
    pair = house_pair()
    cylinder = cut_pair(*pair.pyramids, np.zeros(3), 6.0, pair.classes[1])
    return collate([cylinder, cylinder], TINY, [0.0, 1.0])


@pytest.mark.parametrize("method", list(POINT_NETWORKS))
def test_every_parameter_of_a_point_network_gets_a_gradient(method, batch):
    torch.manual_seed(0)
    model = POINT_NETWORKS[method](TINY)
    if method == "dc3dcd":
        model.class_of.copy_(torch.eye(4)[torch.arange(TINY.clusters) % 4])
    said = model(batch)
    assert said.shape == (batch.compared[0].count, 4)
    assert torch.allclose(said.exp().sum(dim=1), torch.ones(len(said)), atol=1e-5)
    said[torch.arange(len(said)), batch.classes].sum().backward()
    moved = {name: p.grad for name, p in model.named_parameters() if p.requires_grad}
    silent = [name for name, gradient in moved.items() if gradient is None or not gradient.abs().sum() > 0]
    assert silent == []


@pytest.mark.parametrize("method", SUPERVISED)
def test_a_point_network_learns_one_cylinder_by_heart(method, batch):
    torch.manual_seed(1)
    model = POINT_NETWORKS[method](TINY)
    optimiser = torch.optim.SGD(model.parameters(), lr=0.01, momentum=0.9)
    weights = torch.tensor([0.2, 0.8, 1.0, 1.0])
    for _ in range(40):
        optimiser.zero_grad()
        task_loss((model(batch), batch.classes), weights).backward()
        optimiser.step()
    right = (model(batch).argmax(dim=1) == batch.classes).float().mean()
    assert float(right) > 0.98
    assert 0.02 < float((batch.classes == 1).float().mean()) < 0.5


@pytest.mark.parametrize(
    ("method", "millions"), [("siamese-kpconv", 18.4), ("triplet-kpconv", None), ("efs-kpconv", None)]
)
def test_the_published_sizes_give_the_published_number_of_parameters(method, millions):
    config = PointNetworkConfig(width=64, levels=5, kernel_points=25, features=())
    model = POINT_NETWORKS[method](config)
    first = model.decoder.layers[0].linear
    expected = {"siamese-kpconv": 2048 + 1024, "triplet-kpconv": 4096 + 1024, "efs-kpconv": 4096 + 2048}
    assert (first.in_features, first.out_features) == (expected[method], 512)
    if millions is not None:
        assert sum(p.numel() for p in model.parameters()) / 1e6 == pytest.approx(millions, abs=0.6)


@pytest.mark.parametrize("method", list(RASTER_NETWORKS))
def test_a_raster_network_learns_one_patch_by_heart(method):
    torch.manual_seed(2)
    model = RASTER_NETWORKS[method](RasterNetworkConfig(width=8, patch=32, dropout=0.0))
    heights = torch.zeros((2, 2, 32, 32))
    heights[0, 1, 8:16, 8:16] = 1.0
    heights[1, 0, 4:12, 16:24] = 1.0
    codes = torch.full((2, 32, 32), int(Change.UNCHANGED))
    codes[0, 8:16, 8:16] = int(Change.ADDED)
    codes[1, 4:12, 16:24] = int(Change.REMOVED)
    optimiser = torch.optim.Adam(model.parameters(), lr=0.01)
    for _ in range(100):
        optimiser.zero_grad()
        torch.nn.functional.nll_loss(model(heights), codes).backward()
        optimiser.step()
    assert float((model(heights).argmax(dim=1) == codes).float().mean()) > 0.98
    assert all(p.grad is not None for p in model.parameters())


def tiny_training(epochs=2, width=2, **settings):
    steps = {"epochs": epochs, "samples": 2, "batch": 2}
    raster = RasterNetworkConfig(width=width, patch=32)
    return TrainingConfig(
        point_network=TINY, raster_network=raster, point_training=steps, raster_training=steps,
        validation_samples=2, **settings,
    )  # fmt: skip


def point_task(seed=0):
    torch.manual_seed(seed)
    pair = house_pair()
    return PointTask("siamese-kpconv", tiny_training(), [pair], [pair])


def raster_task(seed=0):
    torch.manual_seed(seed)
    codes = np.full((40, 40), int(Change.UNCHANGED))
    codes[5:15, 5:15] = int(Change.ADDED)
    pair = RasterPair(np.stack([np.zeros((40, 40)), 3.0 * (codes == Change.ADDED)]), codes)
    return RasterTask("dsm-siamese", tiny_training(), [pair], [pair])


def cluster_task(seed=0):
    torch.manual_seed(seed)
    pair = house_pair()
    return ClusterTask("dc3dcd", tiny_training(), [pair], [pair])


@pytest.mark.parametrize("make", [point_task, raster_task, cluster_task])
def test_a_training_that_was_stopped_goes_on_as_if_it_had_not_been(make, tmp_path):
    whole = make()
    optimiser = whole.optimiser()
    for epoch in range(2):
        run_epoch(whole, optimiser, 0.01, 100.0, (0, epoch))

    first = make()
    begun = first.optimiser()
    run_epoch(first, begun, 0.01, 100.0, (0, 0))
    state = State(epoch=1, best=model_arrays(first), best_score=3.0)
    write_checkpoint(tmp_path / "c.npz", "key", first, begun, state)

    second = make(seed=9)  # other weights, until the checkpoint is read
    resumed = second.optimiser()
    back = read_checkpoint(tmp_path / "c.npz", "key", second, resumed)
    assert (back.epoch, back.best_score) == (1, 3.0)
    run_epoch(second, resumed, 0.01, 100.0, (0, 1))
    for name, value in model_arrays(whole).items():
        assert np.array_equal(value, model_arrays(second)[name]), name


def raster_job(folder, start=None):
    return TrainingJob("dsm-siamese", (folder / "a",), (folder / "b",), folder / "w.npz", start=start)


@pytest.fixture
def scored(monkeypatch):
    """Trainings of a tiny raster network whose validation scores are given."""
    seen = []

    def install(scores):
        left = iter(scores)

        def score(task):
            seen.append(model_arrays(task))
            return Validation(0.5, next(left), 0.25)

        monkeypatch.setattr(training, "make_task", lambda _job, config, _say: raster_task(config.seed))
        monkeypatch.setattr(training, "score_validation", score)
        return seen

    return install


def silent(_name, _share):
    """Say nothing."""


def equal(first, second):
    return all(np.array_equal(value, second[name]) for name, value in first.items())


def test_a_training_ends_when_its_score_no_longer_rises_and_keeps_the_best_weights(scored, tmp_path):
    seen = scored([0.3, 0.5, 0.4, 0.4, 0.9])
    record = train(raster_job(tmp_path), tiny_training(epochs=5, patience=2), silent)
    assert (record["epochs"], record["best_epoch"], record["validation_miou_percent"]) == (4, 1, 50.0)
    write_weights(tmp_path / "best.npz", seen[1], record)
    assert equal(*(read_weights(tmp_path / name, "dsm-siamese")[0] for name in ("w.npz", "best.npz")))
    assert len((tmp_path / "w.curve.csv").read_text().splitlines()) == 5
    assert (tmp_path / "w.curve.png").stat().st_size > 1000
    assert not (tmp_path / "w.npz.training").exists()


def test_a_killed_training_goes_on_by_the_same_command_to_the_same_weights(scored, tmp_path):
    class Killed(BaseException):
        pass

    def kill(_name, share):
        if share < 1.0:
            raise Killed

    rising = [0.1, 0.2]
    (tmp_path / "whole").mkdir()
    scored(rising)
    train(raster_job(tmp_path / "whole"), tiny_training(), silent)
    scored(rising)
    with pytest.raises(Killed):
        train(raster_job(tmp_path), tiny_training(), kill)
    assert not (tmp_path / "w.npz").exists()
    scored(rising[1:])
    record = train(raster_job(tmp_path), tiny_training(), kill)
    assert (record["epochs"], record["best_epoch"]) == (2, 1)
    assert equal(*(read_weights(tmp_path / n, "dsm-siamese")[0] for n in ("w.npz", "whole/w.npz")))


def test_a_training_that_begins_with_weights_keeps_them_unless_it_scores_higher(scored, tmp_path):
    scored([0.1, 0.2])
    first = train(raster_job(tmp_path), tiny_training(), silent)
    (tmp_path / "w.npz").rename(tmp_path / "start.npz")
    seen = scored([0.6, 0.5, 0.5])
    seen.clear()
    record = train(raster_job(tmp_path, tmp_path / "start.npz"), tiny_training(seed=3), silent)
    begun = read_weights(tmp_path / "start.npz", "dsm-siamese")[0]
    assert equal(begun, seen[0])
    assert not equal(begun, seen[1])
    assert equal(begun, read_weights(tmp_path / "w.npz", "dsm-siamese")[0])
    assert record["best_epoch"] == -1
    assert [e["score_at_the_start"] for e in record["earlier"]] == [60.0]
    assert record["earlier"][0]["epochs"] == first["epochs"]


def test_weights_of_other_sizes_are_refused_to_begin_with(scored, tmp_path):
    scored([0.1, 0.2])
    train(raster_job(tmp_path), tiny_training(), silent)
    with pytest.raises(InputError, match="other settings of raster_network"):
        begin(raster_task(), tiny_training(width=4), tmp_path / "w.npz")


def test_a_checkpoint_of_another_training_is_refused(tmp_path):
    task = raster_task()
    write_checkpoint(tmp_path / "c.npz", "key", task, task.optimiser(), State())
    with pytest.raises(InputError, match="begun with other settings"):
        read_checkpoint(tmp_path / "c.npz", "other", task, task.optimiser())


def test_the_key_of_a_training_names_method_settings_and_surveys(tmp_path):
    job = TrainingJob("dsm-fc-ef", (tmp_path / "a",), (tmp_path / "b",), tmp_path / "w.npz")
    other = TrainingJob("dsm-fc-ef", (tmp_path / "c",), (tmp_path / "b",), tmp_path / "w.npz")
    config = TrainingConfig()
    assert job.key(config) == job.key(TrainingConfig())
    assert len({job.key(config), other.key(config), job.key(TrainingConfig(seed=1))}) == 3


def test_labels_that_are_ignored_do_not_change_the_loss():
    said = torch.log_softmax(torch.randn((6, 4)), dim=1)
    classes = torch.tensor([0, 1, -1, 2, -1, 0])
    kept = classes >= 0
    weights = torch.tensor([0.1, 0.9, 1.0, 1.0])
    assert torch.isclose(task_loss((said, classes), weights), task_loss((said[kept], classes[kept]), weights))
    assert (to_classes(np.array([Change.UNOBSERVED]), 1) == -1).all()


def raised_ground(rise, features):
    """Even ground that is higher in the second epoch, everywhere and without a step."""
    rng = np.random.default_rng(3)
    clouds = [np.column_stack([rng.uniform(-8, 8, (4000, 2)), np.full(4000, z)]) for z in (0.0, rise)]
    pyramids = [build_pyramid(cloud, TINY) for cloud in clouds]
    heights = [np.zeros(4000), np.full(4000, rise)]
    first, second = (
        replace(p, features=point_features(p, pyramids[1 - n], heights[n])) for n, p in enumerate(pyramids)
    )
    pair = tuple(chosen_features(p, features) for p in (first, second))
    return collate([cut_pair(*pair, np.zeros(3), 6.0)], TINY.model_copy(update={"features": features}))


@pytest.mark.parametrize(("features", "sees"), [((), False), (("height",), True)])
def test_only_a_height_feature_shows_a_rise_of_even_ground(features, sees):
    torch.manual_seed(4)
    model = POINT_NETWORKS["siamese-kpconv"](TINY.model_copy(update={"features": features})).eval()
    with torch.no_grad():
        low, high = (model(raised_ground(rise, features)) for rise in (0.0, 0.45))
    assert (not torch.allclose(low, high, atol=1e-3)) is sees


def test_the_signed_network_tells_a_rise_from_a_fall_where_the_published_one_is_blind():
    heights = torch.zeros((1, 2, 32, 32))
    heights[0, 1, 8:16, 8:16] = 1.0
    for skips, blind in (("absolute", True), ("signed", False)):
        torch.manual_seed(0)
        config = RasterNetworkConfig(width=4, patch=32, dropout=0.0, skips=skips)
        model = RASTER_NETWORKS["dsm-siamese"](config).eval()
        given = []
        model.decoder.register_forward_pre_hook(lambda _module, args, given=given: given.append(args[1]))
        model(heights)
        model(heights.flip(1))
        same = [torch.allclose(a, b) for a, b in zip(*given, strict=True)]
        assert same == [blind] * len(same)


def test_powers_of_the_shares_lower_the_claims_of_rare_classes():
    shares = np.array([0.9, 0.09, 0.01])
    assert np.allclose(prior_factors(shares, 0.0), 1.0)
    assert np.allclose(prior_factors(shares, 1.0), shares / 0.9)
    assert (np.diff(prior_factors(shares, 0.5)) < 0).all()


def test_validation_takes_the_power_that_scores_best():
    task = raster_task()
    found = score_validation(task)
    assert found.power in POWERS
    task.shares = np.full(5, 0.2)  # every power is the same
    flat = score_validation(task)
    assert flat.power == 0.0
    assert found.score >= flat.score
    assert found.loss == flat.loss


def test_k_means_finds_directions_that_lie_apart():
    rng = np.random.default_rng(0)
    true = rng.integers(4, size=400)
    directions = np.eye(4)[true] + rng.normal(0, 0.05, (400, 4))
    features = torch.nn.functional.normalize(torch.from_numpy(directions).float(), dim=1)
    centres, labels = spherical_k_means(features, 12, 20, np.random.default_rng(1))
    assert torch.allclose(centres.norm(dim=1), torch.ones(12), atol=1e-5)
    assert torch.equal(labels, (features @ centres.T).argmax(dim=1))
    for cluster in labels.unique():
        assert len(np.unique(true[labels.numpy() == int(cluster)])) == 1


def test_deep_clustering_learns_without_labels_and_names_its_clusters_by_them():
    task = cluster_task()
    unlabelled = cluster_task()
    for pair in unlabelled.training:
        for classes in pair.classes:
            classes[:] = -1
    for one in (task, unlabelled):
        run_epoch(one, one.optimiser(), 0.01, 100.0, (0, 0))
    for name, value in model_arrays(task).items():
        assert np.array_equal(value, model_arrays(unlabelled)[name]), name
    assert task.model.prototypes.weight.grad is None
    score = score_validation(task).score
    named = task.model.class_of
    assert torch.equal(named.sum(dim=1), torch.ones(TINY.clusters))
    assert 0.0 < score <= 1.0
    assert score_validation(unlabelled).score != score


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.npz")), ids=lambda path: path.stem)
def test_shipped_weights_fit_their_network_and_name_their_training(path):
    trained = load_network(path, path.stem)
    record = read_record(path)
    assert sum(p.numel() for p in trained.model.parameters()) == record["parameters"]
    assert all(torch.isfinite(p).all() for p in trained.model.parameters())
    assert len(trained.factors) == (4 if path.stem.endswith("kpconv") else 5)
    assert (trained.factors.max(), trained.factors.min() > 0) == (1.0, True)
    assert record["hours"] > 0
    assert set(record["surveys"]).isdisjoint(record["validation_surveys"])
    assert path.stat().st_size < 2_000_000
