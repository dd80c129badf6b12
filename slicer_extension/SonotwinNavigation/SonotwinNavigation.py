"""A scripted module of 3D Slicer: results of sonotwin with their uncertainty, and its live navigation."""

import time
from pathlib import Path

import ctk
import qt
import slicer
from slicer.ScriptedLoadableModule import (
    ScriptedLoadableModule,
    ScriptedLoadableModuleLogic,
    ScriptedLoadableModuleTest,
    ScriptedLoadableModuleWidget,
)
from SonotwinNavigationLib import navigation, result, show

KEPT = "SonotwinNavigation/"  # of settings
LOOK_MS = 300  # between two looks at what has come
SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#"
)
END_MS = 5000  # until a program that was told to end is killed


class SonotwinNavigation(ScriptedLoadableModule):
    """What Slicer lists."""

    def __init__(self, parent):
        super().__init__(parent)
        parent.title = "sonotwin"
        parent.categories = ["IGT"]
        parent.dependencies = []
        parent.contributors = ["The sonotwin authors"]
        parent.helpText = "Opens a result of sonotwin, and shows where its live navigation has probe, needle and B-scan."
        parent.acknowledgementText = "For research: no medical device."


class SonotwinNavigationWidget(ScriptedLoadableModuleWidget):
    """The panel: a result, and live navigation."""

    def setup(self):
        """Build the panel."""
        super().setup()
        self.logic = SonotwinNavigationLogic()
        self._add_result()
        self._add_navigation()
        self.layout.addStretch(1)
        self._timer = qt.QTimer()
        self._timer.setInterval(LOOK_MS)
        self._timer.connect("timeout()", self._look)

    def cleanup(self):
        """End with the panel."""
        self._timer.stop()
        self.logic.stop()
        self.logic.disconnect()

    def _add_result(self):
        box, form = _box("Result", self.layout)
        self.folder = ctk.ctkPathLineEdit()
        self.folder.filters = ctk.ctkPathLineEdit.Dirs
        self.folder.settingKey = KEPT + "folder"
        self.opened = qt.QLabel()
        self.opened.wordWrap = True
        self.table = qt.QTableWidget()
        self.table.setColumnCount(2)
        self.table.setHorizontalHeaderLabels(["what", "figures, ± one standard deviation; or why it isn't measured"])
        self.table.horizontalHeader().stretchLastSection = True
        button = qt.QPushButton("Open")
        button.connect("clicked()", self._open)
        for name, widget in (("Folder", self.folder), ("", button), ("", self.opened), ("", self.table)):
            form.addRow(name, widget)
        return box

    def _add_navigation(self):
        _, form = _box("Navigation", self.layout)
        settings = qt.QSettings()
        self.host = qt.QLineEdit(settings.value(KEPT + "host", "localhost"))
        self.port = qt.QSpinBox()
        self.port.setRange(1, 65535)
        self.port.value = int(settings.value(KEPT + "port", navigation.PORT))
        self.program = ctk.ctkPathLineEdit()
        self.program.filters = ctk.ctkPathLineEdit.Files
        self.program.settingKey = KEPT + "program"
        self.fields = qt.QLineEdit(settings.value(KEPT + "fields", "capture=outputs/live/capture"))
        self.connect_button, self.start_button = qt.QPushButton("Connect"), qt.QPushButton("Start sonotwin navigate here")
        self.connect_button.connect("clicked()", self._connect)
        self.start_button.connect("clicked()", self._start)
        self.state = qt.QLabel()
        self.state.wordWrap = True
        rows = (("Host", self.host), ("Port", self.port), ("", self.connect_button), ("Program", self.program),
                ("Fields", self.fields), ("", self.start_button), ("", self.state))  # fmt: skip
        for name, widget in rows:
            form.addRow(name, widget)

    def _open(self):
        self.folder.addCurrentPathToHistory()
        try:
            found = self.logic.open_result(Path(self.folder.currentPath))
        except (ValueError, OSError, RuntimeError) as error:
            self.opened.text = str(error)
            return
        self.opened.text = found.search
        rows = [*found.masses, *found.left_out]
        self.table.setRowCount(len(rows))
        for number, row in enumerate(rows):
            self.table.setItem(number, 0, qt.QTableWidgetItem(row.name))
            self.table.setItem(number, 1, qt.QTableWidgetItem(row.told))

    def _connect(self):
        try:
            if self.logic.connector is None:
                self._keep()
                self.logic.connect(self.host.text, self.port.value)
                self._timer.start()
            else:
                self.logic.disconnect()
                self._timer.stop()
                self.state.text = ""
        except ValueError as error:
            self.state.text = str(error)
        self.connect_button.text = "Connect" if self.logic.connector is None else "Disconnect"

    def _start(self):
        try:
            if self.logic.process is None:
                self._keep()
                self.logic.start(navigation.command(self.program.currentPath, self.fields.text, self.port.value))
                self._timer.start()
            else:
                self.logic.stop()
        except ValueError as error:
            self.state.text = str(error)
        self._name_start()

    def _name_start(self):
        self.start_button.text = "Start sonotwin navigate here" if self.logic.process is None else "Stop sonotwin navigate"

    def _look(self):
        self.state.text = "\n".join(self.logic.look())
        self._name_start()

    def _keep(self):
        self.program.addCurrentPathToHistory()
        settings = qt.QSettings()
        for name, value in (("host", self.host.text), ("port", self.port.value), ("fields", self.fields.text)):
            settings.setValue(KEPT + name, value)


def _box(title, layout):
    box = ctk.ctkCollapsibleButton()
    box.text = title
    layout.addWidget(box)
    return box, qt.QFormLayout(box)


class SonotwinNavigationLogic(ScriptedLoadableModuleLogic):
    """Nodes and processes, without a panel."""

    def __init__(self):
        super().__init__()
        self.connector = None  # vtkMRMLIGTLConnectorNode
        self.process = None  # qt.QProcess of `sonotwin navigate`
        self._said = ""  # by it, last
        self._newest = 0  # modification time of what has come
        self._came_s = None  # when that changed, by a steady clock

    def open_result(self, chosen):
        """Show the result in a chosen folder; returns its tables, and raises ValueError where there is none."""
        folder = result.find(chosen)
        tables = result.read(folder)  # first, so that nothing is shown of a damaged folder
        show.show(folder)
        slicer.util.resetThreeDViews()
        return tables

    def connect(self, host, port):
        """Connect to a running `sonotwin navigate`, which may also come later."""
        if not hasattr(slicer.modules, "openigtlinkif"):
            raise ValueError(
                "OpenIGTLink: expected the extension SlicerOpenIGTLink, found none: install it by the extensions manager"
            )
        self.connector = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLIGTLConnectorNode", "sonotwin")
        self.connector.SetTypeClient(host, port)
        self.connector.Start()
        self._newest, self._came_s = 0, None

    def disconnect(self):
        """Stop listening; what has come stays."""
        if self.connector is not None:
            self.connector.Stop()
            slicer.mrmlScene.RemoveNode(self.connector)
            self.connector = None

    def start(self, command):
        """Start `sonotwin navigate` on this computer, with the environment that Slicer was started in."""
        process, environment = qt.QProcess(), qt.QProcessEnvironment()
        for name, value in slicer.util.startupEnvironment().items():
            environment.insert(name, value)
        process.setProcessEnvironment(environment)
        process.setProcessChannelMode(qt.QProcess.MergedChannels)
        process.start(command[0], command[1:])
        if not process.waitForStarted():
            raise ValueError(f"{command[0]}: expected a program that starts, found: {process.errorString()}")
        self.process, self._said = process, ""

    def stop(self):
        """End it."""
        if self.process is not None:
            self.process.terminate()
            if not self.process.waitForFinished(END_MS):
                self.process.kill()
                self.process.waitForFinished(END_MS)
            self.process = None

    def look(self):
        """Lines of what is going on; puts the probe under its transform, and a slice view where the B-scan is."""
        lines = []
        if self.process is not None:
            said = bytes(self.process.readAll().data()).decode(errors="replace").strip()
            self._said = said.splitlines()[-1] if said else self._said
            lines = [self._said] if self._said else []
            if self.process.state() == qt.QProcess.NotRunning:
                lines = [f"sonotwin navigate has ended with status {self.process.exitCode()}: {self._said}"]
                self.process = None
        if self.connector is None:
            return lines
        if self.connector.GetState() != slicer.vtkMRMLIGTLConnectorNode.StateConnected:
            return [*lines, "not connected: waiting for sonotwin navigate"]
        nodes = {name: _first(name) for name in (*navigation.TEXTS, navigation.SCAN, navigation.TARGET, navigation.IN_TARGET)}
        self._place(nodes)
        came = [nodes[name] for name in (*navigation.TEXTS, navigation.SCAN, navigation.TARGET) if nodes[name] is not None]
        newest, now = max([node.GetMTime() for node in came], default=0), time.monotonic()
        if newest > self._newest:
            self._newest, self._came_s = newest, now
        texts = {name: nodes[name].GetText() for name in navigation.TEXTS if nodes[name] is not None}
        return lines + navigation.status(texts, None if self._came_s is None else now - self._came_s)

    def _place(self, nodes):
        probe, target, scan = (nodes[name] for name in (navigation.IN_TARGET, navigation.TARGET, navigation.SCAN))
        if probe is not None and target is not None and probe.GetTransformNodeID() != target.GetID():
            probe.SetAndObserveTransformNodeID(target.GetID())
        if scan is not None:
            view = slicer.app.layoutManager().sliceWidget("Red")
            view.sliceLogic().GetSliceCompositeNode().SetBackgroundVolumeID(scan.GetID())
            view.mrmlSliceNode().RotateToVolumePlane(scan)
            view.sliceLogic().SnapSliceOffsetToIJK()
            view.mrmlSliceNode().SetSliceVisible(True)


def _first(name):
    """The node of a message's name, or None."""
    nodes = slicer.mrmlScene.GetNodesByName(name)
    return nodes.GetItemAsObject(0) if nodes.GetNumberOfItems() else None


class SonotwinNavigationTest(ScriptedLoadableModuleTest):
    """Run by Slicer, without data from elsewhere."""

    def setUp(self):
        """Begin with nothing."""
        slicer.mrmlScene.Clear()

    def runTest(self):
        """All of them."""
        self.setUp()
        self.test_a_result_lies_where_it_was_measured()
        self.test_a_folder_without_a_result_is_refused()

    def test_a_result_lies_where_it_was_measured(self):
        """A triangle and a mass's centre, at (10, -20, 660) mm of the world, so at (-10, 20, 660) of RAS."""
        folder = Path(slicer.util.tempDirectory()) / "slicer"
        folder.mkdir()
        (folder / "show.py").write_text("", encoding="utf-8")
        (folder / "search.txt").write_text("Masses were looked for: 1 was found.", encoding="utf-8")
        properties = "".join(f"property float {axis}\n" for axis in "xyz")
        face = "element face 1\nproperty list uchar int vertex_indices\n"
        head = f"ply\nformat ascii 1.0\nelement vertex 3\n{properties}{face}end_header\n"
        (folder / "mass0.ply").write_text(f"{head}10 -20 660\n11 -20 660\n10 -19 660\n3 0 1 2\n", encoding="utf-8")
        point = '{"id": "1", "label": "mass0", "description": "centre", "position": [10, -20, 660], "positionStatus": "defined"}'
        markups = f'{{"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": [{point}]}}'
        (folder / "masses.mrk.json").write_text(f'{{"@schema": "{SCHEMA}", "markups": [{markups}]}}', encoding="utf-8")
        tables = SonotwinNavigationLogic().open_result(folder.parent)
        self.assertEqual([row.name for row in tables.masses], ["mass0"])
        bounds = [0.0] * 6
        slicer.util.getNode("mass0").GetRASBounds(bounds)
        for found, expected in zip(bounds, (-11, -10, 19, 20, 660, 660)):
            self.assertAlmostEqual(found, expected, places=3)
        centre = [0.0] * 3
        slicer.util.getNode("masses").GetNthControlPointPositionWorld(0, centre)
        for found, expected in zip(centre, (-10, 20, 660)):
            self.assertAlmostEqual(found, expected, places=3)

    def test_a_folder_without_a_result_is_refused(self):
        """In one line."""
        with self.assertRaisesRegex(ValueError, "expected a result with a folder slicer"):
            SonotwinNavigationLogic().open_result(Path(slicer.util.tempDirectory()))
