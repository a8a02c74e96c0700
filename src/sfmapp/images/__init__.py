"""Where pixels come from: files, arrays, video, EXIF and masks."""
