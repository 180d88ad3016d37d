"""Column names of public drive-test tools and of Wi-Fi and Bluetooth loggers: guessed right, or asked about."""

from __future__ import annotations

import io

import numpy as np
import pandas as pd
import pytest

from calibray.errors import InputError
from calibray.measurements import SourceTable, column_names, transmitter_columns

GEOGRAPHIC = ("Longitude", "Latitude")

# Header, typical row, column and quantity of the values, columns of the receiver's position.
HEADERS = {
    "G-NetTrack": (
        "Timestamp,Longitude,Latitude,Speed,Operatorname,CellID,NetworkMode,RSRP,RSRQ,SNR,CQI,RSSI,DL_bitrate,"
        "UL_bitrate,State,NRxRSRP,NRxRSRQ",
        "2017.11.22_10.07.03,-8.5,51.8,4,A,2,LTE,-102,-14,2.0,6,-94,5178,194,D,-120.0,-18.0",
        "RSRP", "rsrp", GEOGRAPHIC,
    ),
    "G-NetTrack Pro": (
        "Time,Operator,CGI,Node,CellID,LAC,Level,Qual,SNR,Longitude,Latitude,Altitude,Speed,Accuracy",
        "10:01,A,1,2,3,4,-95,-9,12,9.9,50.0,210,1,5",
        "Level", "rsrp", GEOGRAPHIC,
    ),
    "TEMS Investigation": (
        "All-Time,All-Latitude,All-Longitude,All-Timing Advance,All-Serving Cell Identity[1],"
        "All-Serving Cell DL EARFCN[1],All-Serving Cell RSRP (dBm)[1],All-Serving Cell RSRQ (dB)[1],"
        "All-Neighbor Cell RSRP (dBm)[1]",
        "10:01,50.0,9.9,3,77,1300,-97.5,-11.0,-101.0",
        "All-Serving Cell RSRP (dBm)[1]", "rsrp", ("All-Longitude", "All-Latitude"),
    ),
    "TEMS Pocket": (
        "Time,Lat,Lon,Serving RSRP,Serving RSRQ,Serving SINR,Serving RSSI",
        "10:01,50.0,9.9,-99,-12,4,-71",
        "Serving RSRP", "rsrp", ("Lon", "Lat"),
    ),
    "Nemo Outdoor": (
        "Time,Longitude,Latitude,Height,RSRP (dBm),RSRQ (dB),RSSI (dBm),EARFCN",
        "10:01,9.9,50.0,1.5,-98.1,-11.4,-70.2,1300",
        "RSRP (dBm)", "rsrp", GEOGRAPHIC,
    ),
    "Nemo Handy": (
        "Lon.,Lat.,LTE RSRP dBm,LTE RSRQ dB",
        "9.9,50.0,-98.1,-11.4",
        "LTE RSRP dBm", "rsrp", ("Lon.", "Lat."),
    ),
    "Nemo 3G scanner": (
        "Time,Longitude,Latitude,RSCP,Ec/N0,RSSI",
        "10:01,9.9,50.0,-85.5,-7.5,-71.0",
        "RSCP", "rsrp", GEOGRAPHIC,
    ),
    "QualiPoc": (
        "MsgTime,Position Longitude,Position Latitude,LTE RSRP,LTE RSRQ,LTE RSSI,LTE SINR,PCI",
        "10:01,9.9,50.0,-101.2,-12.0,-72.0,6.1,120",
        "LTE RSRP", "rsrp", ("Position Longitude", "Position Latitude"),
    ),
    "LTE serving-cell export": (
        "Timestamp,Longitude,Latitude,LTE Serving Cell RSRP (dBm),LTE Serving Cell RSRQ (dB),"
        "LTE Serving Cell RS SINR (dB)",
        "10:01,9.9,50.0,-101.2,-12.0,6.1",
        "LTE Serving Cell RSRP (dBm)", "rsrp", GEOGRAPHIC,
    ),
    "XCAL": (
        "TIME_STAMP,Lat,Lon,LTE KPI PCell Serving RSRP[dBm],LTE KPI PCell SINR[dB],LTE KPI PCell Serving RSRQ[dB]",
        "10:01,50.0,9.9,-93.0,11.0,-10.0",
        "LTE KPI PCell Serving RSRP[dBm]", "rsrp", ("Lon", "Lat"),
    ),
    "SigCap LTE": (
        "timestamp,latitude,longitude,altitude,hor_acc,pci,lte_primary_band,lte_primary_rsrp(dBm),"
        "lte_primary_rsrq(dB),lte_primary_rssi(dBm)",
        "10:01,50.0,9.9,180,4,12,66,-91,-10,-61",
        "lte_primary_rsrp(dBm)", "rsrp", ("longitude", "latitude"),
    ),
    "SigCap 5G": (
        "timestamp,latitude,longitude,nr_ssRsrp,nr_ssRsrq,nr_ssSinr",
        "10:01,50.0,9.9,-88,-11,17",
        "nr_ssRsrp", "rsrp", ("longitude", "latitude"),
    ),
    "Network Signal Guru": (
        "Time,Lon,Lat,PCI,EARFCN,RSRP,RSRQ,SINR,RSSI,Tx Power",
        "10:01,9.9,50.0,3,1300,-96.4,-10.3,9.1,-66.0,12.0",
        "RSRP", "rsrp", ("Lon", "Lat"),
    ),
    "WiGLE": (
        "MAC,SSID,AuthMode,FirstSeen,Channel,Frequency,RSSI,CurrentLatitude,CurrentLongitude,AltitudeMeters,"
        "AccuracyMeters,RCOIs,MfgrId,Type",
        "aa:bb,net,[WPA2],2024-01-01 10:00:00,6,2437,-71,50.0,9.9,180.0,4.0,,,WIFI",
        "RSSI", "rsrp", ("CurrentLongitude", "CurrentLatitude"),
    ),
    "WiGLE 1.4": (
        "MAC,SSID,AuthMode,FirstSeen,Channel,RSSI,CurrentLatitude,CurrentLongitude,AltitudeMeters,AccuracyMeters,Type",
        "aa:bb,net,[ESS],2024-01-01 10:00:00,11,-83,50.0,9.9,180.0,4.0,WIFI",
        "RSSI", "rsrp", ("CurrentLongitude", "CurrentLatitude"),
    ),
    "OpenCellID upload": (
        "mcc,mnc,lac,cellid,lon,lat,signal,measured_at,rating,speed,direction,act",
        "262,1,20,1294,9.9,50.0,-79,1371713733,5,0,0,LTE",
        "signal", "rsrp", ("lon", "lat"),
    ),
    "Radio Mapper": (
        "time,latitude,longitude,height,freqMHz,signalStrength_dBm",
        "10:01,50.0,9.9,1.5,868.3,-104.0",
        "signalStrength_dBm", "rsrp", ("longitude", "latitude"),
    ),
    "Android CellInfoLte": (
        "timestamp,lat,lon,ci,pci,tac,earfcn,rsrp,rsrq,rssnr,asuLevel,level",
        "1371713733,50.0,9.9,1294,17,20,1300,-104,-13,30,36,2",
        "rsrp", "rsrp", ("lon", "lat"),
    ),
    "Android CellInfoNr": (
        "timestamp,lat,lon,nci,pci,nrarfcn,ssRsrp,ssRsrq,ssSinr,csiRsrq,asuLevel,dbm,level",
        "1371713733,50.0,9.9,1294,17,632628,-97,-11,14,-10,43,-97,3",
        "ssRsrp", "rsrp", ("lon", "lat"),
    ),
    "Android CellInfoGsm": (
        "time,latitude,longitude,cid,arfcn,bsic,dbm,asuLevel,timingAdvance",
        "1371713733,50.0,9.9,1294,17,20,-81,16,0",
        "dbm", "rsrp", ("longitude", "latitude"),
    ),
    "Android WifiScan": (
        "timestamp,BSSID,SSID,level,frequency,posX,posY",
        "1371713733,aa:bb,net,-64,2412,3.0,4.5",
        "level", "rsrp", ("posX", "posY"),
    ),
    "CellMapper": (
        "Latitude,Longitude,Altitude,MCC,MNC,LAC,CID,Signal,type,subtype,ARFCN,PSC/PCI",
        "50.0,9.9,180,262,1,20,1294,-101,LTE,0,1300,12",
        "Signal", "rsrp", GEOGRAPHIC,
    ),
    "Mobile Site Survey": (
        "Time,Latitude,Longitude,Carrier,Cell ID,Service Display,Band,RSSI,SINR,RSRP,RSRQ,State,Download,Upload",
        "10:01,50.0,9.9,A,7,LTE,Band 4,-63,11,-92,-9,connected,10,2",
        "RSRP", "rsrp", GEOGRAPHIC,
    ),
    "NextGIS Logger": (
        "ID,Name,User,TimeStamp,NetworkGen,NetworkType,Active,MCC,MNC,LAC,CID,PSC,Power,Lat,Long",
        "1,walk,me,1409513090236,4G,LTE,1,262,1,20,1294,12,-105,50.0,9.9",
        "Power", "rsrp", ("Long", "Lat"),
    ),
    "NB-IoT scanner": (
        "Date,Time,UTC,Latitude,Longitude,Altitude,EARFCN,NPCI,NSINR,NRSRP,NRSRQ,RSSI,ToA,eNodeB ID,BSLatitude,"
        "BSLongitude",
        "01.02,10:01,1,41.9,12.5,33,6352,12,5.1,-81.6,-3.1,-71.2,6.1,1,41.91,12.51",
        "NRSRP", "rsrp", GEOGRAPHIC,
    ),
    "LoRa mapper": (
        "time,gatewayId,rxLat,rxLon,rssi,snr,spreadingFactor",
        "10:01,gw,50.0,9.9,-112,-3.5,9",
        "rssi", "rsrp", ("rxLon", "rxLat"),
    ),
    "LoRaWAN Antwerp": (
        "dev_eui,RX Time,Latitude,Longitude,HDOP,SF,RSSI (dBm)",
        "aa,10:01,51.2,4.4,0.8,7,-109",
        "RSSI (dBm)", "rsrp", GEOGRAPHIC,
    ),
    "Bluetooth beacons": (
        "location_x,location_y,date,beaconId,RSSI",
        "3.0,4.5,10:01,b3001,-78",
        "RSSI", "rsrp", ("location_x", "location_y"),
    ),
    "ESP32 scanner": (
        "millis,mac,rssi,x_m,y_m",
        "1000,aa:bb,-71,1.0,2.0",
        "rssi", "rsrp", ("x_m", "y_m"),
    ),
    "Kismet": (
        "Network,BSSID,FirstTime,Channel,MaxRate,BestQuality,BestSignal,BestNoise,GPSBestLat,GPSBestLon,GPSBestAlt",
        "1,aa:bb,10:01,6,54,0,-72,-95,50.0,9.9,180",
        "BestSignal", "rsrp", ("GPSBestLon", "GPSBestLat"),
    ),
    "Ekahau": (
        "Point,X [m],Y [m],AP name,Signal strength [dBm],SNR [dB],Noise [dBm]",
        "1,2.0,3.0,ap-1,-58,32,-95",
        "Signal strength [dBm]", "rsrp", ("X [m]", "Y [m]"),
    ),
    "Channel sounder": (
        "TX_ID,RX_ID,rxX,rxY,rxZ,txX,txY,txZ,pathLossdB,delaySpread_ns",
        "1,4,10.0,2.0,1.5,0.0,0.0,10.0,104.2,31.0",
        "pathLossdB", "path_loss", ("rxX", "rxY"),
    ),
    "Sounder report": (
        "T-R Separation Distance (m),Received Power (dBm),Path Loss (dB),RMS Delay Spread (ns),RX_X (m),RX_Y (m)",
        "120,-85.0,115.0,30.0,5.0,8.0",
        "Path Loss (dB)", "path_loss", ("RX_X (m)", "RX_Y (m)"),
    ),
    "Measuring receiver, German": (
        "Messpunkt;Rechtswert;Hochwert;Höhe;Empfangspegel [dBm];Rauschen [dBm];Frequenz [MHz]".replace(";", ","),
        "1,200.0,145.4,1.5,-30.6,-95.0,2450.0",
        "Empfangspegel [dBm]", "rsrp", ("Rechtswert", "Hochwert"),
    ),
    "Drive test, German": (
        "Uhrzeit,Längengrad,Breitengrad,Funkzelle,Signalpegel dBm,Qualität dB",
        "10:01,9.9,50.0,A,-88.0,-9.0",
        "Signalpegel dBm", "rsrp", ("Längengrad", "Breitengrad"),
    ),
    "Drive test, Spanish": (
        "Fecha,Hora,Longitud,Latitud,Celda,Nivel de señal (dBm),Calidad (dB)",
        "04/05/2023,10:01,-3.7,40.4,MAD-01,-61.2,-14.3",
        "Nivel de señal (dBm)", "rsrp", ("Longitud", "Latitud"),
    ),
    "Survey, French": (
        "Heure,Longitude,Latitude,Cellule,Puissance reçue (dBm),Bruit (dBm)",
        "10:01,2.3,48.8,B,-77.1,-99.0",
        "Puissance reçue (dBm)", "rsrp", GEOGRAPHIC,
    ),
    "Sounder, German": (
        "Ort,x [m],y [m],Pfaddämpfung [dB],Antennenhöhe [m]",
        "a,12.0,4.0,101.5,2.0",
        "Pfaddämpfung [dB]", "path_loss", ("x [m]", "y [m]"),
    ),
    "TTN Mapper": (
        "time,dev_eui,gateway_eui,gateway_latitude,gateway_longitude,latitude,longitude,altitude,hdop,rssi,snr,sf,frequency",
        "10:01,70B3,eui-b8,51.2,4.4,51.21,4.41,8,1.5,-99,6.0,7,868100000",
        "rssi", "rsrp", ("longitude", "latitude"),
    ),
    "CW scanner": (
        "Easting,Northing,Freq_MHz,Prx(dBm)",
        "456000,5540000,3500,-88.1",
        "Prx(dBm)", "rsrp", ("Easting", "Northing"),
    ),
    "Gain sweep": (
        "point,x,y,PathGain(dB)",
        "1,2.0,3.0,-76.5",
        "PathGain(dB)", "path_gain", ("x", "y"),
    ),
}  # fmt: skip

# Header, typical row, message.
ASKED = {
    "UJIIndoorLoc in long form": (
        "WAP,SignalPow,LONGITUDE,LATITUDE,FLOOR,BUILDINGID,TIMESTAMP",
        "WAP105,-70,-7541.26,4864920.78,2,1,1371713733",
        "position",
    ),
    "OpenCellID cells": (
        "lat,lon,mcc,mnc,lac,cellid,averageSignalStrength,range,samples",
        "50.0,9.9,262,1,20,1294,0,1000,3",
        "no column appears to contain path loss, path gain or received power",
    ),
    "Quality only": ("lat,lon,RSRQ,SINR", "50.0,9.9,-12,5", "no column appears to contain"),
    "Signal in percent": ("x,y,SSID,Signal Quality", "1,2,net,74", "no column appears to contain"),
    "Round-trip times only": ("X,Y,RTT(mm),AP", "1,2,5120,1", "no column appears to contain"),
    "Neighbours only": ("Lat,Lon,NRxRSRP,NRxRSRQ", "50.0,9.9,-120,-18", "no column appears to contain"),
    "Pixel coordinates": ("col,row,rssi", "120,80,-70", "position"),
}


def read(header: str, row: str) -> SourceTable:
    return SourceTable(pd.read_csv(io.StringIO("\n".join([header, row, row, row]))), source="log.csv")


@pytest.mark.parametrize("tool", HEADERS)
def test_headers_of_public_tools_are_guessed(tool):
    header, row, value, quantity, position = HEADERS[tool]
    table = read(header, row)
    guess = column_names.find_value(table)
    assert (guess.column, guess.quantity) == (value, quantity)
    rx = column_names.find_position(table.frame, "rx", unnamed=True)
    assert (rx.x, rx.y) == position


@pytest.mark.parametrize("tool", ASKED)
def test_headers_that_cannot_be_guessed_are_asked_about(tool):
    header, row, message = ASKED[tool]
    table = read(header, row)
    if message == "position":
        assert column_names.find_position(table.frame, "rx", unnamed=True) is None
    else:
        with pytest.raises(InputError, match=message):
            column_names.find_value(table)


def test_there_are_forty_header_rows():
    assert len(HEADERS) + len(ASKED) >= 40


def test_base_stations_in_camel_case_are_transmitters():
    header, row, *_ = HEADERS["NB-IoT scanner"]
    tx = column_names.find_position(read(header, row).frame, "tx", unnamed=False)
    assert (tx.position, tx.x, tx.y) == ("geographic", "BSLongitude", "BSLatitude")


@pytest.mark.parametrize(
    ("header", "names", "columns"),
    [
        (
            "Unnamed: 0,X,Y,AP1 RTT(mm),AP2 RTT(mm),AP1 RSS(dBm),AP2 RSS(dBm),LOS APs",
            ["AP1", "AP2"],
            {"AP1 RSS(dBm)": "AP1", "AP2 RSS(dBm)": "AP2"},
        ),
        ("WAP001,WAP002,WAP003,LONGITUDE,LATITUDE", ["WAP001", "WAP003"], {"WAP001": "WAP001", "WAP003": "WAP003"}),
        ("WAP001,WAP002,Pos_x,Pos_y,Floor_ID", ["WAP001", "WAP002"], {"WAP001": "WAP001", "WAP002": "WAP002"}),
        ("x,y,snr_a,snr_b,rssi_a,rssi_b", ["a", "b"], {"rssi_a": "a", "rssi_b": "b"}),
        ("location,date,b3001,b3002,b3003", ["b3001", "b3002"], {"b3001": "b3001", "b3002": "b3002"}),
        ("x,y,RTT a,RTT b", ["a", "b"], {}),
    ],
)  # fmt: skip
def test_wide_columns_are_found_next_to_other_quantities(header, names, columns):
    assert transmitter_columns.find_wide_columns(pd.DataFrame(columns=header.split(",")), names) == columns


def test_columns_of_unknown_transmitters_are_named():
    frame = pd.DataFrame(columns=["X", "AP1 RSS(dBm)", "AP2 RSS(dBm)", "AP13 RSS(dBm)", "AP13 RTT(mm)"])
    columns = transmitter_columns.find_wide_columns(frame, ["AP1", "AP2"])
    assert transmitter_columns.find_unknown_wide_columns(frame, columns) == ["AP13 RSS(dBm)"]


@pytest.mark.parametrize(
    ("names", "unit"),
    [
        (["X [cm]", "Y [cm]", "Höhe [cm]"], 0.01),
        (["x_mm", "y_mm"], 0.001),
        (["Tx X (ft)", "Tx Y (ft)"], 0.3048),
        (["x", "y_m"], 1.0),
        (["longitude", "latitude"], 1.0),
    ],
)
def test_units_of_length_are_read_from_names(names, unit):
    assert column_names.find_length_unit(names) == unit


def test_several_units_of_length_are_asked_about():
    with pytest.raises(
        InputError, match=r"different units \(X \[cm\], height_m\); give all positions in metres"
    ):
        column_names.find_length_unit(["X [cm]", "height_m", "n"])


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("TimeOfFlight [ns]", "time_of_flight"),
        ("time_of_flight_ns", "time_of_flight"),
        ("round_trip_time_ns", "round_trip_time"),
        ("Round-Trip Time (ns)", "round_trip_time"),
    ],
)
def test_flight_times_are_found_by_their_full_name_and_are_no_times_of_day(name, kind):
    frame = pd.DataFrame({name: [80.0, 90.0], "flight_time_s": [1.0, 2.0]})
    assert column_names.find_flight_time(frame) == (name, kind, "ns")
    assert column_names.find_time(frame) == "flight_time_s"


def test_values_are_judged_without_the_codes_of_missing_ones():
    table = SourceTable(pd.DataFrame({"x": 1.0, "rssi": [100.0, 100.0, 100.0, -71.0, -80.0]}))
    guess = column_names.find_value(table)
    assert (guess.column, guess.reason) == ("rssi", "by its name and values of about -76")
    assert np.isfinite(table.frame["rssi"]).all()


@pytest.mark.parametrize(
    "name",
    ["device", "Gerät", "Endgeraet", "Mobiltelefon", "Empfänger", "teléfono", "Dispositivo", "appareil", "Téléphone",
     "ricevitore", "Cellulare"],
)  # fmt: skip
def test_columns_of_devices_are_found_in_five_languages(name):
    frame = pd.DataFrame({"Zelle": ["a", "b"], name: ["S21", "Pixel"], "Straße": ["Nord", "Süd"]})
    assert transmitter_columns.find_devices(frame) == [name]


@pytest.mark.parametrize("name", ["tx_power_w", "Tx power [mW]", "EIRP [dBW]", "eirp_dbw"])
def test_transmitted_powers_in_other_units_are_not_taken_for_dbm(name):
    assert column_names.find_transmit_power(pd.DataFrame({name: [20.0]})) is None
    assert (
        column_names.find_transmit_power(pd.DataFrame({name: [20.0], "EIRP [dBm]": [43.0]})) == "EIRP [dBm]"
    )


@pytest.mark.parametrize(
    "name", ["Velocidad [km/h]", "Speed (km/h)", "speed_km_h", "GPS speed [m/s]", "Time [h]"]
)
def test_units_of_speeds_and_hours_are_not_heights(name):
    """Nearly every export of a drive test has a speed."""
    frame = pd.DataFrame({"Longitude": [9.9], "Latitude": [50.0], name: [31.0]})
    assert column_names.find_position(frame, "rx", unnamed=True).height is None
    named = column_names.find_position(frame.assign(h=1.5), "rx", unnamed=True)
    assert named.height == "h"
