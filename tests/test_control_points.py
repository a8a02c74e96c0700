"""Lists of ground control points: what is read, and how what is wrong is refused."""

import numpy as np
import pytest

from sfmapp.errors import InputError
from sfmapp.formats.control_points import read_control_points

SIZES = {"north/a.jpg": (4000, 3000), "north/b.JPG": (4000, 3000), "south/c.jpg": (1500, 2000)}
ODM = """WGS84 UTM 32N
# taken on Tuesday
500010.5 5400020.25 101.5 100 200 a.jpg church
500010.5 5400020.25 101.5 110.5 210 north/b.JPG church
500090 5400000 99 10 20 b.jpg
500090 5400000 99 1400 1900.5 c.jpg
"""
TABLE = """# crs: EPSG:32632
name,x,y,z,sigma_x,sigma_y,sigma_z,image,px,py,sigma_px
church,500010.5,5400020.25,101.5,0.01,0.01,0.02,north/a.jpg,100.5,200.5,0.5
church,,,,,,,north/b.JPG,111,210.5,
2,500090,5400000,99,,,,north/b.JPG,10.5,20.5,
2,500090,5400000,99,,,,south/c.jpg,1400.5,1901,
"""


def read(tmp_path, text, name="gcp_list.txt"):
    path = tmp_path / name
    path.write_text(text)
    return read_control_points(path, SIZES)


def test_odms_list_counts_pixels_from_the_centre_of_the_first(tmp_path):
    points = read(tmp_path, ODM)
    assert points.crs == "WGS84 UTM 32N"
    assert points.names == ("church", "point1")
    np.testing.assert_array_equal(points.xyz, [[500010.5, 5400020.25, 101.5], [500090, 5400000, 99]])
    np.testing.assert_array_equal(points.obs_point_idx, [0, 0, 1, 1])
    np.testing.assert_array_equal(points.obs_image_idx, [0, 1, 1, 2])
    np.testing.assert_array_equal(points.obs_xy, [[100.5, 200.5], [111, 210.5], [10.5, 20.5], [1400.5, 1901]])
    np.testing.assert_array_equal(points.observations_of(1), [2, 3])


def test_a_table_says_the_same_with_standard_deviations(tmp_path):
    odm, points = read(tmp_path, ODM), read(tmp_path, TABLE, "points.csv")
    assert points.crs == "EPSG:32632"
    for name in ("xyz", "obs_point_idx", "obs_image_idx", "obs_xy"):
        np.testing.assert_array_equal(getattr(points, name), getattr(odm, name))
    np.testing.assert_array_equal(points.sigma_m, [[0.01, 0.01, 0.02], [0.02, 0.02, 0.03]])
    np.testing.assert_array_equal(points.obs_sigma_px, [0.5, 1, 1, 1])
    assert points.obs_line.tolist() == [3, 4, 5, 6]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "found no line"),
        ("EPSG:25832\n", "found none"),
        (ODM.partition("\n")[2], "line 2: expected a coordinate system in the first line"),
        (ODM.replace("10 20 b.jpg", "10 20"), "line 5: expected at least 6 words, found 5"),
        (ODM.replace(" 99 10", " 9m 10"), "line 5: expected a number for z, found '9m'"),
        (ODM.replace(" 99 10", " nan 10"), "line 5: expected a number for z"),
        (ODM.replace("1400 1900.5", "1600 1900.5"), r"line 6: .*south/c.jpg, which has 1500 x 2000, found \(1600.5"),
        (ODM.replace("1400 1900.5", "-3 1900.5"), "line 6: expected a pixel"),
        (ODM.replace("c.jpg", "d.jpg"), "line 6: .*found 'd.jpg'"),
        (ODM.replace("north/b.JPG", "a.jpg"), "line 4: expected one mark of point 'church' .* line 3"),
        (ODM + "500000 5400000 90 1 1 a.jpg lonely\n", "line 7: expected point 'lonely' in two photographs"),
        (ODM.replace("101.5 110.5", "101.6 110.5"), "line 4: expected the coordinates .*'church' that line 3 has"),
        (ODM + "500090 5400000 99 1 1 a.jpg X\n500090 5400000 99 1 1 b.jpg X\n", "line 7: .*'X' than for 'point1'"),
        (TABLE.replace("# crs: EPSG:32632", ""), "expected a line '# crs"),
        (TABLE.replace("0.01,0.01,0.02", "0.01,0,0.02"), "line 3: expected standard deviations above zero, found 0 m"),
        (TABLE.replace("200.5,0.5", "200.5,-1"), "line 3: expected standard deviations above zero, found -1 px"),
        (TABLE.replace("px,py", "u,v"), "line 2: expected known columns, found 'u'"),
        (TABLE.replace(",sigma_px", "").replace("px,", ""), "line 2: expected a column 'px'"),
        (TABLE.replace("1400.5,1901,", "1400.5,1901"), "line 6: expected 11 fields, found 10"),
        (TABLE.replace("church,,", ",,"), "line 4: expected names"),
        (TABLE.replace("2,500090,5400000,99", "2,,,"), "line 5: expected coordinates of point '2'"),
        (TABLE.replace("500010.5,", ","), "line 3: expected a number for x"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_refused_with_its_line(tmp_path, text, expected):
    with pytest.raises(InputError, match=expected) as refused:
        read(tmp_path, text)
    assert "gcp_list.txt" in str(refused.value)
    assert refused.value.advice


def test_a_table_without_its_comment_is_told_how_tables_begin(tmp_path):
    with pytest.raises(InputError, match="line 2: expected at least 6 words") as refused:
        read(tmp_path, TABLE.replace("# crs: ", ""))
    assert "# crs: EPSG" in refused.value.advice


def test_a_name_that_two_photographs_have_is_no_name(tmp_path):
    path = tmp_path / "gcp_list.txt"
    path.write_text(ODM)
    with pytest.raises(InputError, match=r"line 3: .*of which there are 2") as refused:
        read_control_points(path, {**SIZES, "east/a.jpg": (4000, 3000)})
    assert refused.value.advice == "give it with its folder"


def test_bytes_that_are_no_text(tmp_path):
    path = tmp_path / "gcp_list.txt"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="UTF-8"):
        read_control_points(path, SIZES)
