"""Settings of the learned methods: networks, sampling and training.

Defaults are the sizes that two CPU cores train in minutes; ``config/learned_published.yaml`` holds the
sizes of the publications.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from subiaco_geo.config import StrictModel

Feature = Literal[
    "height",
    "stability",
    "verticality",
    "linearity",
    "planarity",
    "omnivariance",
    "height_rank",
    "height_range",
]


class PointNetworkConfig(StrictModel):
    """Kernel point convolutions on cylinders of two clouds."""

    width: int = Field(
        16, ge=4, multiple_of=4, description="Number of features after the first layer (published: 64)"
    )
    levels: int = Field(
        4,
        ge=2,
        le=6,
        description="Number of grids, each twice as coarse as the one before (published: 5)",
    )
    first_grid: float = Field(
        0.5, gt=0, description="Edge of the voxels of the finest grid [m] (published: 1.0, or 0.5 for AHN)"
    )
    radius: float = Field(
        15.0,
        gt=0,
        description="Radius of the cylinders that are classified [m] (published: 50; AHN: 25)",
    )
    features: tuple[Feature, ...] = Field(
        ("height", "stability"),
        description="Hand-made features of a point beside the constant 1; published: none (2023), or "
        "all with the normal (2024)",
    )
    neighbours: int = Field(
        20, ge=4, description="Largest number of neighbours in a convolution (published: 25 to 38)"
    )
    kernel_points: int = Field(
        15, ge=5, description="Number of kernel points of a convolution (published: 25)"
    )
    search: float = Field(
        2.5,
        gt=0,
        description="Radius of the neighbourhood as a multiple of the edge of the grid (published)",
    )
    kernel_extent: float = Field(
        1.5,
        gt=0,
        description="Mean distance of the kernel points from the centre as a multiple of the grid edge "
        "(published)",
    )
    clusters: int = Field(100, ge=2, description="Number of clusters of DC3DCD (published: 1000)")
    temperature: float = Field(
        0.1, gt=0, description="Inverse factor of the similarity of features and prototypes of DC3DCD"
    )
    batch_norm_momentum: float = Field(
        0.02, gt=0, le=1, description="Weight of a new batch in the batch statistics (published)"
    )
    dropout: float = Field(
        0.5, ge=0, lt=1, description="Fraction of features dropped before the last layer (published)"
    )


class RasterNetworkConfig(StrictModel):
    """Fully convolutional networks on two digital surface models."""

    width: int = Field(12, ge=2, description="Number of features of the first layer (published: 16)")
    patch: int = Field(
        96,
        ge=16,
        multiple_of=16,
        description="Edge of the patches that are classified [cells] (published)",
    )
    height_scale: float = Field(
        5.0, gt=0, description="Height difference from the middle of a patch that is the input 1 [m]"
    )
    dropout: float = Field(0.2, ge=0, lt=1, description="Fraction of features dropped (published)")
    skips: Literal["absolute", "signed"] = Field(
        "absolute",
        description="Difference that the Siamese network hands to its decoder: without its sign (published), "
        "or with it",
    )


class PointTrainingConfig(StrictModel):
    """Stochastic gradient descent on cylinders."""

    epochs: int = Field(20, ge=1, description="Number of epochs (published: 550)")
    samples: int = Field(200, ge=1, description="Number of cylinders of an epoch (published: 6000)")
    batch: int = Field(2, ge=1, description="Number of cylinders of a step (published: 10)")
    learning_rate: float = Field(0.01, gt=0, description="Factor of the first steps (published)")
    momentum: float = Field(0.98, ge=0, lt=1, description="Momentum factor of the optimiser (published)")
    weight_decay: float = Field(1e-3, ge=0, description="Coefficient of the weight decay (published)")
    final_rate: float = Field(
        0.00173,
        gt=0,
        le=1,
        description="Ratio of the last learning rate to the first one; 0.9885 an epoch over 550 epochs "
        "(published)",
    )
    clip: float = Field(
        100.0, gt=0, description="Coefficient to which single gradients are limited (published)"
    )
    cluster_iterations: int = Field(
        20, ge=1, description="Number of k-means iterations of DC3DCD in an epoch (published)"
    )
    labelled: int = Field(
        60,
        ge=1,
        description="Number of labelled cylinders by which the clusters of DC3DCD get their classes; no "
        "gradient comes from a label",
    )
    noise: float = Field(
        0.01, ge=0, description="Standard deviation of the noise added to coordinates [m] (published)"
    )
    noise_limit: float = Field(0.05, ge=0, description="Largest noise of a coordinate [m] (published)")


class RasterTrainingConfig(StrictModel):
    """Adam on patches."""

    epochs: int = Field(40, ge=1, description="Number of epochs (published: 50)")
    samples: int = Field(128, ge=1, description="Number of patches of an epoch")
    batch: int = Field(4, ge=1, description="Number of patches of a step (published: 32)")
    learning_rate: float = Field(1e-3, gt=0, description="Factor of the first steps (common for Adam)")
    weight_decay: float = Field(1e-4, ge=0, description="Coefficient of the weight decay (published)")
    final_rate: float = Field(
        0.077,
        gt=0,
        le=1,
        description="Ratio of the last learning rate to the first one; 0.95 an epoch over 50 epochs "
        "(published)",
    )
    clip: float = Field(100.0, gt=0, description="Coefficient to which single gradients are limited")


class TrainingConfig(StrictModel):
    """Everything that decides how a network is built and trained."""

    seed: int = Field(0, ge=0, description="Seed of weights, sampling and augmentation")
    patience: int = Field(
        12,
        ge=1,
        description="Number of epochs without a better validation score after which training ends",
    )
    validation_samples: int = Field(
        40,
        ge=1,
        description="Number of cylinders or patches that are scored after every epoch; they are drawn "
        "evenly over the validation surveys",
    )
    swap_epochs: bool = Field(
        True,
        description="Whether surface models are also learned with exchanged epochs and reversed labels",
    )
    point_network: PointNetworkConfig = PointNetworkConfig()
    raster_network: RasterNetworkConfig = RasterNetworkConfig()
    point_training: PointTrainingConfig = PointTrainingConfig()
    raster_training: RasterTrainingConfig = RasterTrainingConfig()


class LearnedConfig(StrictModel):
    """How trained networks are applied."""

    weights: str = Field(
        "", description="File of trained weights; empty takes the weights that are shipped for the method"
    )
    overlap: float = Field(
        0.3,
        ge=0.3,
        lt=1,
        description="Fraction of a cylinder or patch that the next one overlaps; predictions are averaged",
    )
