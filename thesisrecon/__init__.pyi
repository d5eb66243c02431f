"""Public names and the modules that define them; the reference pages follow this order."""
# ruff: noqa: I001

# Whole runs
from thesisrecon.api.reconstruct import reconstruct as reconstruct
from thesisrecon.api.add_images import reconstruct_with_cameras as reconstruct_with_cameras
from thesisrecon.api.add_images import add_images as add_images
from thesisrecon.api.add_images import localize as localize
from thesisrecon.api.from_matches import reconstruct_from_matches as reconstruct_from_matches
from thesisrecon.api.from_matches import reconstruct_from_tracks as reconstruct_from_tracks
from thesisrecon.api.from_matches import reconstruct_from_colmap as reconstruct_from_colmap
from thesisrecon.api.models import load as load
from thesisrecon.api.models import save as save
from thesisrecon.config import PipelineConfig as PipelineConfig
from thesisrecon.results import RunResult as RunResult

# Two and three images
from thesisrecon.api.pairs import detect_corners as detect_corners
from thesisrecon.api.pairs import match_pair as match_pair
from thesisrecon.api.pairs import estimate_fundamental as estimate_fundamental
from thesisrecon.api.pairs import estimate_homography as estimate_homography
from thesisrecon.api.pairs import estimate_trifocal as estimate_trifocal
from thesisrecon.api.relative_pose import estimate_essential as estimate_essential
from thesisrecon.api.relative_pose import recover_pose as recover_pose
from thesisrecon.api.relative_pose import decompose_homography as decompose_homography
from thesisrecon.api.decompositions import essential_from_fundamental as essential_from_fundamental
from thesisrecon.api.decompositions import decompose_essential as decompose_essential
from thesisrecon.api.decompositions import seven_point as seven_point
from thesisrecon.api.pairs import epipolar_lines as epipolar_lines
from thesisrecon.api.pairs import draw_epipolar_lines as draw_epipolar_lines
from thesisrecon.epipolar.degeneracy import FundamentalEstimate as FundamentalEstimate
from thesisrecon.records import FundamentalFit as FundamentalFit
from thesisrecon.records import TwoView as TwoView

# One image, and panoramas
from thesisrecon.api.single_view import vanishing_points as vanishing_points
from thesisrecon.api.single_view import rectify_plane as rectify_plane
from thesisrecon.api.single_view import single_view_heights as single_view_heights
from thesisrecon.api.single_view import calibrate_from_homographies as calibrate_from_homographies
from thesisrecon.api.panorama import stitch as stitch

# Points and cameras
from thesisrecon.camera import Camera as Camera
from thesisrecon.api.cameras import triangulate as triangulate
from thesisrecon.api.cameras import resect as resect
from thesisrecon.api.cameras import cheirality as cheirality
from thesisrecon.api.decompositions import decompose_camera as decompose_camera
from thesisrecon.api.decompositions import factorize_affine as factorize_affine
from thesisrecon.api.averaging import average_rotations as average_rotations
from thesisrecon.api.averaging import average_translations as average_translations
from thesisrecon.api.bundle import bundle_adjust as bundle_adjust
from thesisrecon.api.bundle import BundleAdjustment as BundleAdjustment
from thesisrecon.records import Reconstruction as Reconstruction
from thesisrecon.api.cameras import reconstruction_from_cameras as reconstruction_from_cameras
from thesisrecon.records import Tracks as Tracks
from thesisrecon.records import Image as Image

# Strata and self-calibration
from thesisrecon.api.calibrate import self_calibrate as self_calibrate
from thesisrecon.records import SelfCalibration as SelfCalibration
from thesisrecon.api.calibrate import plane_at_infinity as plane_at_infinity
from thesisrecon.api.calibrate import upgrade_affine as upgrade_affine
from thesisrecon.api.calibrate import kruppa as kruppa

# Stereo and surfaces
from thesisrecon.api.surface import rectify as rectify
from thesisrecon.api.lenses import rectify_cameras as rectify_cameras
from thesisrecon.api.lenses import undistort_points as undistort_points
from thesisrecon.api.lenses import undistort_image as undistort_image
from thesisrecon.api.surface import match_rectified as match_rectified
from thesisrecon.records import DisparityMap as DisparityMap
from thesisrecon.api.surface import depth_maps as depth_maps
from thesisrecon.records import DepthMap as DepthMap
from thesisrecon.api.surface import fuse_depth_maps as fuse_depth_maps
from thesisrecon.api.surface import texture as texture
from thesisrecon.records import TexturedMesh as TexturedMesh

# New views
from thesisrecon.api.views import render as render
from thesisrecon.api.views import interpolate_view as interpolate_view
from thesisrecon.api.views import synthesize_view as synthesize_view

# Models and files
from thesisrecon.api.models import read_cameras as read_cameras
from thesisrecon.io._images import sample as sample
from thesisrecon.api.export import export as export
from thesisrecon.api.export import write_mesh as write_mesh
from thesisrecon.api.export import read_mesh as read_mesh
from thesisrecon.api.models import align_to_positions as align_to_positions
from thesisrecon.api.models import scaled as scaled
from thesisrecon.api.models import scaled_by_points as scaled_by_points
from thesisrecon.api.models import compare_models as compare_models
from thesisrecon.results import ModelComparison as ModelComparison

# Errors
from thesisrecon.errors import StageFailure as StageFailure
from thesisrecon.errors import UsageError as UsageError

__version__: str
