# SPDX-License-Identifier: Apache-2.0
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription
from launch.actions import EmitEvent, RegisterEventHandler
from launch.event_handlers import OnProcessStart
from launch.events import Shutdown


def test_thin(run, fake, capfd):
    planner = ContainerInstance(name='planner')
    node = CloudNode(machine=planner, package='demo', executable='talker', output='screen')
    def say(machine, spec):
        machine.say('output', spec, stream='stdout', text='hello from there\n')
        machine.say('exited', spec, returncode=0, respawns=False)
    fake.on_start = say
    status = run(FogROSLaunchDescription([node]))
    print(fake.notes)
    out = capfd.readouterr().out
    print(out)
    assert status == 0
    assert 'hello from there' in out
