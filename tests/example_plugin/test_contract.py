from coslidar_example import PowerOfDistance

from coslidar.plugins.conformance import parametrize_with_checks


@parametrize_with_checks([PowerOfDistance, PowerOfDistance(exponent=0)])
def test_contract(plugin, check):
    check(plugin)
