"""Frames in order: folders, videos, KITTI, TUM and EuRoC."""
